"""Streams of random numbers that never share a seed."""

from enum import IntEnum


class Stream(IntEnum):
    """Streams of random numbers that must not meet: the second number of every seed."""

    SCENE_ORDER = 0
    TRAINING_VIEWS = 1
    EVAL_VIEWS = 2
    BATCHES = 3
    VIEWPOINTS = 4
    REGISTRATION_ORDER = 5
    SHARDS = 6
