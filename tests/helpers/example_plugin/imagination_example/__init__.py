"""An example plugin: a scene source, a unit and a callback."""
