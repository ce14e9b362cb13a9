"""Example plugin with a scene source, a unit and a callback."""
