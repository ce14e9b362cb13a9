"""Pictures of maps: categories in colour over occupancy."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32, UInt8

from imagination.mapping.semantic_map import FREE, OCCUPIED, Maps

Colours = Sequence[tuple[int, int, int]]
Picture = UInt8[np.ndarray, "h w 3"]

FREE_COLOUR, OCCUPIED_COLOUR, UNKNOWN_COLOUR = (255, 255, 255), (60, 60, 60), (205, 205, 205)
FAINT = 0.1
"""Smallest probability that is drawn."""


def draw_map(maps: Maps, colours: Colours) -> Picture:
    """Draw occupancy in grey and each category in its colour, opaque from its threshold on and faint below it."""
    layer = maps.occupancy_layer()
    picture = np.full((*layer.shape, 3), UNKNOWN_COLOUR, np.float32)
    picture[layer == FREE] = FREE_COLOUR
    picture[layer == OCCUPIED] = OCCUPIED_COLOUR
    return paint(picture, maps.probabilities, colours, maps.thresholds)


def paint(
    picture: Float32[np.ndarray, "h w 3"],
    probabilities: Float32[np.ndarray, "c h w"],
    colours: Colours,
    thresholds: Sequence[float],
) -> Picture:
    """Blend the categories' colours over a picture; see `draw_map`."""
    for layer, colour, threshold in zip(probabilities, colours, thresholds, strict=True):
        weight = np.select([layer >= threshold, layer >= FAINT], [np.float32(0.85), 0.5 * layer / threshold])
        picture = picture + weight[..., None] * (np.array(colour, np.float32) - picture)
    rounded: Picture = np.rint(picture).astype(np.uint8)
    return rounded
