"""Shapes, surfaces and pieces that furniture and scenes are built from; plugins may import them."""
