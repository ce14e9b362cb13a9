"""Spatial imagination with semantic cognition: train, evaluate and deploy networks that predict top-down maps."""
