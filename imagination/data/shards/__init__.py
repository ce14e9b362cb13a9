"""Data sets of views on disk (litdata shards), written scene by scene and streamed in training."""
