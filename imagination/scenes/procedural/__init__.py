"""Procedural homes generated from a seed: floor plan, furniture, textures and lighting, without assets."""
