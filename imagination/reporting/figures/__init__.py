"""Figures of maps, scores, single views and training curves."""
