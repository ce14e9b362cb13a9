"""Utilities independent of the rest of the project: errors, files, cache, progress, precision."""
