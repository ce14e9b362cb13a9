"""Composition, validation and error messages of configurations."""
