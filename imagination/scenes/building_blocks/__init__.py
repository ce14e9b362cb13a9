"""Building blocks of furniture and scenes: shapes, textures, finishes and pieces; a public API for plugins."""
