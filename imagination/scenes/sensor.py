"""Sensor models between the renderer and the user of the image."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from imagination.scenes.renderer import Image

Sensor = Callable[[Image, np.random.Generator], Image]
"""Turns the renderer's image into the image of the robot's sensor."""


@dataclass(frozen=True)
class IdealSensor:
    """A sensor without noise."""

    def __call__(self, image: Image, rng: np.random.Generator) -> Image:
        """Return the image unchanged; `rng` is for sensors that add noise."""
        return image
