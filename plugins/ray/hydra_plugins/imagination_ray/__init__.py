"""Members of a sweep on a Ray cluster. Hydra takes launchers from packages under `hydra_plugins` only."""
