"""Sensor models: what stands between the renderer and whoever uses the image."""

from dataclasses import dataclass

import numpy as np

from imagination.scenes.renderer import Image


@dataclass(frozen=True)
class IdealSensor:
    """A sensor without noise: it passes the renderer's image on."""

    def __call__(self, image: Image, rng: np.random.Generator) -> Image:
        """The image as the robot gets it; `rng` is for sensors that add noise."""
        return image
