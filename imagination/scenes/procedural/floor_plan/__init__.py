"""Floor plans and the mesh of the building."""
