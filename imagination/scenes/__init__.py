"""Scenes, scene sources, free space, the renderer and procedural homes."""
