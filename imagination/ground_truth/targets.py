"""Training targets of a unit: the imaginable mask, the label and the seen-object neighbourhood.

Equations of the paper's sections "Imaginable Filter", "Imagination" and "Mapping". Maps are egocentric, with any number
of leading axes (batch, category); a seen map with size 1 in such an axis is broadcast.
"""

import numpy as np
from jaxtyping import Bool

from imagination.geometry.morphology import dilate


def neighbourhood(
    objects: Bool[np.ndarray, "*b v v"], seen: Bool[np.ndarray, "*#b v v"], epsilon: int
) -> Bool[np.ndarray, "*b v v"]:
    """Return the seen-object neighbourhood, M*_seen = dilation(V_object * V_seen, epsilon).

    Args:
        objects: V_object. In the loss it is the crop of the ground truth; after prediction it is
            `prediction >= tau_valid`, because a sigmoid is never 0 and every seen cell would count as an object
            otherwise (settled reading).
        seen: V_seen.
        epsilon: side of the dilation kernel, cells.
    """
    return dilate(objects & seen, epsilon)


def imaginable_mask(
    objects: Bool[np.ndarray, "*b v v"], seen: Bool[np.ndarray, "*#b v v"], delta: int
) -> Bool[np.ndarray, "*b v v"]:
    """Return the imaginable mask, V_filter = dilation(V_object * V_seen, delta): cells near seen parts of objects.

    The equation is that of M*_seen with another kernel. Objects without a seen part, such as those behind walls, are
    excluded.

    Args:
        objects: V_object, the crop of the ground truth M_gt.
        seen: V_seen.
        delta: side of the dilation kernel, cells.
    """
    return neighbourhood(objects, seen, delta)


def label(
    objects: Bool[np.ndarray, "*b v v"], seen: Bool[np.ndarray, "*#b v v"], delta: int
) -> Bool[np.ndarray, "*b v v"]:
    """Return the label, V_label = V_object * V_filter; the arguments are those of `imaginable_mask`."""
    target: np.ndarray = objects & imaginable_mask(objects, seen, delta)
    return target
