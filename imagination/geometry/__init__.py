"""Camera, poses, grids, projection and morphology, in NumPy, Numba and OpenCV only (docs/concepts/conventions.md)."""
