"""Spatial imagination with semantic cognition: train, compare and use networks that imagine top-down maps."""
