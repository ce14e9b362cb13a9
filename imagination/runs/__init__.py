"""Runs: their folders, locks, logs, checkpoints, resuming and sweeps."""
