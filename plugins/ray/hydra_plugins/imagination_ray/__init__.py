"""Launcher of sweeps on a Ray cluster. Hydra finds launchers in packages under `hydra_plugins` only."""
