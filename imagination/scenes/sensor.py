"""Sensor models, which turn rendered images into sensor images."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from imagination.scenes.renderer import Image


@runtime_checkable
class Sensor(Protocol):
    """Model of the robot's sensor."""

    def __call__(self, image: Image, rng: np.random.Generator) -> Image:
        """Return the image of the sensor from a rendered image."""


@dataclass(frozen=True)
class IdealSensor:
    """Sensor without noise."""

    def __call__(self, image: Image, rng: np.random.Generator) -> Image:
        """Return the image unchanged; `rng` is used by noisy sensors only."""
        return image
