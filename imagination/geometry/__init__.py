"""Camera, poses, grids, projection and morphology; numpy, numba and OpenCV only (docs/conventions.md)."""
