"""Furniture by family: shapes and their ranges in each split."""
