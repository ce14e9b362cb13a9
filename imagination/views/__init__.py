"""Views of scenes: pose samplers, rendering of single views, and collection by worker processes."""
