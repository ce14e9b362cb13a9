"""Helpers that know nothing of the project: errors, files, cache, progress, precision."""
