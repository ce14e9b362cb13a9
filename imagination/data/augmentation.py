"""Views as a mirror shows them: as true as the views themselves, and new to a network."""

import numpy as np
from jaxtyping import Bool

from imagination.views.collector import Views


def mirrored(views: Views, which: Bool[np.ndarray, " n"]) -> Views:
    """Some of the views with left and right exchanged, in images and maps alike; the others as they are.

    The camera's axis is the image's middle, and the robot's column that of the egocentric grid. Poses are left out: a
    mirrored scene has other ones.

    Args:
        views: stacked views.
        which: those to mirror.
    """
    turned = {}
    for name in views.keys() - {"pose"}:
        values = views[name]
        columns = -2 if name == "rgb" else -1  # colours come last
        turned[name] = values.copy()
        turned[name][which] = np.flip(values[which], columns)
    return turned
