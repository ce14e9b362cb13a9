"""Sensor models, which turn rendered images into sensor images."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from imagination.scenes.renderer import Image

Sensor = Callable[[Image, np.random.Generator], Image]
"""Function from a rendered image to the image of the robot's sensor."""


@dataclass(frozen=True)
class IdealSensor:
    """Sensor without noise."""

    def __call__(self, image: Image, rng: np.random.Generator) -> Image:
        """Return the image unchanged; `rng` is used by noisy sensors only."""
        return image
