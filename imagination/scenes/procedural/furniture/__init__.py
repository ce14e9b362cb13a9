"""Furniture by family: shapes and their parameter ranges in each split."""
