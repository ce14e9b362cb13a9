"""Composing, checking and explaining configurations."""
