"""Independent streams of random numbers."""

from enum import IntEnum


class Stream(IntEnum):
    """Identifier of a random stream, the second number of every seed, so that streams are independent."""

    SCENE_ORDER = 0
    TRAINING_VIEWS = 1
    EVAL_VIEWS = 2
    BATCHES = 3
    VIEWPOINTS = 4
    REGISTRATION_ORDER = 5
    SHARDS = 6
