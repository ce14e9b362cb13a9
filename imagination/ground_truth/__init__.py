"""Ground truth: maps of a whole scene and the targets of a unit in one view."""
