"""The imagination module as the mapper sees it: the units of all categories side by side, whatever runs them."""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import reduce
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from imagination.geometry.camera import Camera
from imagination.geometry.grid import MAX_CELLS, EgoGrid
from imagination.geometry.morphology import kernel_cells
from imagination.geometry.projection import Band
from imagination.ground_truth.targets import neighbourhood
from imagination.utils.errors import UserError, check_range

VERSION = 2
"""Of the description in a unit's file."""

RESERVED = ("map", "objects", "occupancy")
"""Names that no category may have: map files and topics of the map itself have them."""


@dataclass(frozen=True)
class UnitSpec:
    """What a unit was trained with; part of its file.

    Attributes:
        categories: that it imagines, one map each.
        colours: of the categories in pictures, RGB, 0 to 255.
        thresholds: of the categories, probabilities from which a cell is of an object; what training chose on views of
            validation homes, since a loss that weighs cells, as the paper's does, moves probabilities away from 0.5.
        camera: whose images it takes.
        ego: grid of its maps.
        obstacles: heights that count as occupied.
        valid_threshold, valid_kernel: tau_valid, and epsilon in metres, of M*_seen.
    """

    categories: tuple[str, ...]
    colours: tuple[tuple[int, int, int], ...]
    thresholds: tuple[float, ...]
    camera: Camera
    ego: EgoGrid
    obstacles: Band
    valid_threshold: float = 0.5
    valid_kernel: float = 0.62

    def __post_init__(self) -> None:
        if not self.categories or len(set(self.categories)) < len(self.categories):
            raise UserError(
                f"units: got the categories {list(self.categories)}, expected each once and at least one"
            )
        for name in self.categories:  # they become names of files
            if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_-]*", name) or name in RESERVED:
                raise UserError(
                    f"units: got the category {name!r}, expected letters, digits, _ and -, not {', '.join(RESERVED)}"
                )
        for name in ("colours", "thresholds"):
            if (count := len(getattr(self, name))) != len(self.categories):
                raise UserError(f"units: got {count} {name} for {len(self.categories)} categories")
        for threshold in self.thresholds:
            check_range("thresholds", threshold, 0.0, 1.0, open_low=True)
        check_range("ego.resolution", self.ego.resolution, 0.005, 1.0, "m")
        check_range("ego.cells", self.ego.cells, 3, MAX_CELLS, "cells")
        check_range("valid_threshold", self.valid_threshold, 0.0, 1.0)
        check_range("valid_kernel", self.valid_kernel, 0.0, 100.0, "m")

    def to_json(self, **more: Any) -> str:
        """The description as text, with further entries for people."""
        return json.dumps({"version": VERSION, **asdict(self), "obstacles": self.obstacles._asdict(), **more})

    @classmethod
    def from_json(cls, text: str, origin: str) -> "UnitSpec":
        """Read a description.

        Raises:
            UserError: if it is none or of another version.
        """
        try:
            values: Mapping[str, Any] = json.loads(text)
            if values["version"] != VERSION:
                raise UserError(
                    f"{origin}: got version {values['version']}, expected {VERSION}; export it again"
                )
            return cls(
                tuple(map(str, values["categories"])),
                tuple((int(r), int(g), int(b)) for r, g, b in values["colours"]),
                tuple(map(float, values["thresholds"])),
                Camera(**values["camera"]),
                EgoGrid(**values["ego"]),
                Band(**values["obstacles"]),
                float(values["valid_threshold"]),
                float(values["valid_kernel"]),
            )
        except UserError:
            raise
        except (KeyError, TypeError, AttributeError, ValueError, OverflowError, RecursionError) as error:
            raise UserError(
                f"{origin}: its description cannot be read ({error!r}); export it with imagination.export"
            ) from error


class Observation(NamedTuple):
    """What a unit is given: an image of the camera it was trained with, and the depth's projection.

    Attributes:
        rgb, depth: colour, and metres along the optical axis (0: no return).
        occupied, seen: the projection, as `project_depth` makes it.
        mount_height: of the camera above the floor, metres.
    """

    rgb: UInt8[np.ndarray, "h w 3"]
    depth: Float32[np.ndarray, "h w"]
    occupied: Bool[np.ndarray, "v v"]
    seen: Bool[np.ndarray, "v v"]
    mount_height: float


@runtime_checkable
class ImaginationModule(Protocol):
    """Trained units, ready to be asked."""

    spec: UnitSpec

    def __call__(self, observation: Observation) -> Float32[np.ndarray, "c v v"]:
        """Probabilities of V_object of each category."""


class UnitEnsemble:
    """Several modules as one.

    Raises:
        UserError: if they are of different cameras or grids, or share a category.
    """

    def __init__(self, modules: Sequence[ImaginationModule]) -> None:
        self.modules = list(modules)
        self.spec = reduce(joined, (module.spec for module in modules))

    def __call__(self, observation: Observation) -> Float32[np.ndarray, "c v v"]:
        return np.concatenate([module(observation) for module in self.modules])


class ViewEvidence(NamedTuple):
    """What views say.

    Attributes:
        values: of cells.
        mask: cells that they have something to say about.
        imagined: those of them that they did not see; None if they saw all.
    """

    values: Float32[np.ndarray, "*b v v"]
    mask: Bool[np.ndarray, "*b v v"]
    imagined: Bool[np.ndarray, "*b v v"] | None = None


def valid_imagination(
    probabilities: Float32[np.ndarray, "*b v v"],
    seen: Bool[np.ndarray, "*#b v v"],
    threshold: float,
    kernel: float,
    resolution: float,
) -> ViewEvidence:
    """V_valid = prediction * M*_seen, M*_seen = dilation([prediction >= tau_valid] * V_seen, epsilon).

    A view has something to say about the cells it saw, where it denies what is not valid, and about M*_seen.

    Args:
        probabilities: what the units imagine.
        seen: V_seen.
        threshold: tau_valid.
        kernel: epsilon, metres.
        resolution: metres per cell.
    """
    valid = neighbourhood(probabilities >= threshold, seen, kernel_cells(kernel, resolution))
    return ViewEvidence(np.where(valid, probabilities, np.float32(0)), valid | seen, valid & ~seen)


def joined(one: UnitSpec, other: UnitSpec) -> UnitSpec:
    """The description of units side by side.

    Raises:
        UserError: if they are of different cameras or grids, or share a category.
    """
    for name in ("camera", "ego", "obstacles", "valid_threshold", "valid_kernel"):
        if getattr(one, name) != getattr(other, name):
            raise UserError(
                f"units: got the {name} {getattr(one, name)} of {', '.join(one.categories)} and "
                f"{getattr(other, name)} of {', '.join(other.categories)}, expected one; use units trained alike"
            )
    own = ("categories", "colours", "thresholds")  # of each category
    return replace(one, **{name: getattr(one, name) + getattr(other, name) for name in own})
