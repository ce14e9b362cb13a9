"""Datasets of views on disk (litdata shards), written scene by scene and streamed during training."""
