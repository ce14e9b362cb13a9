"""Imagination units, their parts and losses, and the networks they are compared with."""
