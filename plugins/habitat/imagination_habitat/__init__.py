"""Scenes that habitat-sim renders."""
