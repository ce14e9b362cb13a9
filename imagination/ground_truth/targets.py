"""What a unit is asked to imagine: the imaginable mask, the label and the seen-object neighbourhood.

Equations of the paper's sections "Imaginable Filter", "Imagination" and "Mapping". Maps are egocentric; any number of
leading axes (batch, category) is allowed, and a map of the seen area with 1 in such an axis serves all its layers.
"""

import numpy as np
from jaxtyping import Bool

from imagination.geometry.morphology import dilate


def neighbourhood(
    objects: Bool[np.ndarray, "*b v v"], seen: Bool[np.ndarray, "*#b v v"], epsilon: int
) -> Bool[np.ndarray, "*b v v"]:
    """The seen-object neighbourhood, M*_seen = dilation(V_object * V_seen, epsilon).

    Args:
        objects: V_object. In the loss the truth's crop; after prediction `prediction >= tau_valid`, since a sigmoid is
            never 0 and every seen cell would count as an object otherwise (settled reading).
        seen: V_seen.
        epsilon: kernel, cells.
    """
    return dilate(objects & seen, epsilon)


def imaginable_mask(
    objects: Bool[np.ndarray, "*b v v"], seen: Bool[np.ndarray, "*#b v v"], delta: int
) -> Bool[np.ndarray, "*b v v"]:
    """Where objects can be imagined, V_filter = dilation(V_object * V_seen, delta): near a part that is seen.

    The rule of M*_seen with a kernel of its own. Objects of which nothing is seen, such as those behind walls, are out.

    Args:
        objects: V_object, the crop of the ground truth M_gt.
        seen: V_seen.
        delta: kernel, cells.
    """
    return neighbourhood(objects, seen, delta)


def label(
    objects: Bool[np.ndarray, "*b v v"], seen: Bool[np.ndarray, "*#b v v"], delta: int
) -> Bool[np.ndarray, "*b v v"]:
    """What the unit is asked to imagine, V_label = V_object * V_filter; arguments as for `imaginable_mask`."""
    target: np.ndarray = objects & imaginable_mask(objects, seen, delta)
    return target
