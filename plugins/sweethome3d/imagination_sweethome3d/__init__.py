"""Sweet Home 3D: catalogue furniture for procedural homes, and hand-drawn homes as scenes."""
