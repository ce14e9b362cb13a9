"""Sweet Home 3D: designed furniture for our floor plans, and homes that people drew."""
