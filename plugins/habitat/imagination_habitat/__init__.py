"""Scenes rendered by habitat-sim."""
