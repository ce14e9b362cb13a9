"""Imagination units, their parts and losses, and the baseline networks."""
