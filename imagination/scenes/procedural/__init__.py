"""Furnished homes made by rule from a seed: floor plan, furniture, textures, light; no assets needed."""
