"""Which furniture goes into a room, and where."""
