"""Kinds of tasks, as saved runs name them; importable without torch."""

from enum import StrEnum


class TaskKind(StrEnum):
    """Kind of prediction that a network learns; the value of `model.predicts` in a config."""

    MAPS = "maps"
    """Egocentric maps of objects, the task of an imagination unit."""

    IMAGES = "images"
    """First-person segmentation of images."""

    @property
    def networks(self) -> str:
        """Name of the networks in titles."""
        return {"maps": "units", "images": "first-person segmentation"}[self]
