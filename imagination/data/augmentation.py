"""Data augmentation by horizontal flips."""

import numpy as np
from jaxtyping import Bool

from imagination.views.collector import Views


def mirrored(views: Views, selected: Bool[np.ndarray, " n"]) -> Views:
    """Flip selected views horizontally, images and maps alike; copy the others unchanged.

    The flips of images and maps agree, because the optical axis passes through the image's middle and the robot stands
    in the middle column of the egocentric grid. Poses are left out: they differ in a mirrored scene.

    Args:
        views: stacked views.
        selected: mask of the views to flip.

    Returns:
        Stacked views without poses.
    """
    flipped = {}
    for name in views.keys() - {"pose"}:
        values = views[name]
        axis = -2 if name == "rgb" else -1  # the last axis of rgb holds the colours
        flipped[name] = values.copy()
        flipped[name][selected] = np.flip(values[selected], axis)
    return flipped
