"""Looking around: poses, sparse viewpoints, single views and their collection by worker processes."""
