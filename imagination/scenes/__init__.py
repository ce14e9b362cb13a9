"""Where views come from: scenes, their sources, the renderer and the procedural homes."""
