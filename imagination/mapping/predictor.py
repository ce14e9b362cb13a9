"""Runtime-independent interface of the mapper to trained units: predictors, specifications and view evidence."""

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
"""Format version of the unit specification in a unit's file."""

RESERVED = ("map", "objects", "occupancy")
"""Names that no category may have because files and topics of the map use them."""


@dataclass(frozen=True)
class UnitSpec:
    """Specification of a trained unit, stored in its file.

    Attributes:
        categories: names of the categories, one predicted map each.
        colours: RGB colours of the categories in pictures, 0 to 255.
        thresholds: probability of each category from which a cell belongs to an object, selected by training on views
            of validation scenes, because a loss that weights cells (as in the paper) moves probabilities away from 0.5.
        camera: camera of the training images.
        ego: grid of the egocentric maps.
        obstacles: band of heights that count as occupied.
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
                f"units: got the categories {list(self.categories)}, expected at least one and no repetition"
            )
        for name in self.categories:  # used as file names
            if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_-]*", name) or name in RESERVED:
                raise UserError(
                    f"units: got the category {name!r}, expected letters, digits, _ and -, but not "
                    f"{', '.join(RESERVED)}"
                )
        for name in ("colours", "thresholds"):
            if (count := len(getattr(self, name))) != len(self.categories):
                raise UserError(
                    f"units: got {count} {name}, expected {len(self.categories)}, one per category"
                )
        for threshold in self.thresholds:
            check_range("thresholds", threshold, 0.0, 1.0, open_low=True)
        check_range("ego.resolution", self.ego.resolution, 0.005, 1.0, "m")
        check_range("ego.cells", self.ego.cells, 3, MAX_CELLS, "cells")
        check_range("valid_threshold", self.valid_threshold, 0.0, 1.0)
        check_range("valid_kernel", self.valid_kernel, 0.0, 100.0, "m")

    def to_json(self, **extra: Any) -> str:
        """Serialize the specification, with extra entries for human readers."""
        return json.dumps(
            {"version": VERSION, **asdict(self), "obstacles": self.obstacles._asdict(), **extra}
        )

    @classmethod
    def from_json(cls, text: str, origin: str) -> "UnitSpec":
        """Parse a specification; unknown entries are ignored.

        Raises:
            UserError: if the text is invalid or of another version.
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
                f"{origin}: the unit specification cannot be read ({error!r}); export it with imagination.export"
            ) from error


class Observation(NamedTuple):
    """Input of a unit: an image of the training camera and the projection of its depth.

    Attributes:
        rgb, depth: colour, and metres along the optical axis (0: no return).
        occupied, seen: projection of the depth; see `project_depth`.
        mount_height: height of the camera above the floor, metres.
    """

    rgb: UInt8[np.ndarray, "h w 3"]
    depth: Float32[np.ndarray, "h w"]
    occupied: Bool[np.ndarray, "v v"]
    seen: Bool[np.ndarray, "v v"]
    mount_height: float


@runtime_checkable
class MapPredictor(Protocol):
    """Trained units that predict egocentric maps from an observation.

    Attributes:
        spec: specification of the units.
    """

    spec: UnitSpec

    def __call__(self, observation: Observation) -> Float32[np.ndarray, "c v v"]:
        """Predict the probabilities of V_object for each category."""


class UnitEnsemble:
    """Combines predictors of different categories into one.

    Raises:
        UserError: if cameras or grids differ, or two predictors have a category in common.
    """

    def __init__(self, predictors: Sequence[MapPredictor]) -> None:
        self.predictors = list(predictors)
        self.spec = reduce(join_specs, (predictor.spec for predictor in predictors))

    def __call__(self, observation: Observation) -> Float32[np.ndarray, "c v v"]:
        return np.concatenate([predictor(observation) for predictor in self.predictors])


class ViewEvidence(NamedTuple):
    """Evidence of a view (or a batch of views) about egocentric cells, to be registered in a map.

    Attributes:
        values: probabilities of the cells.
        mask: cells with evidence, observed or imagined.
        imagined: cells of `mask` that the view did not observe; None if it observed all of them.
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
    """Compute V_valid = prediction * M*_seen with M*_seen = dilation([prediction >= tau_valid] * V_seen, epsilon).

    The evidence of a view covers the observed cells (probability 0 where the prediction is not valid) and M*_seen.

    Args:
        probabilities: predictions of the units.
        seen: V_seen, the observed cells.
        threshold: tau_valid.
        kernel: epsilon, metres.
        resolution: metres per cell.
    """
    valid = neighbourhood(probabilities >= threshold, seen, kernel_cells(kernel, resolution))
    return ViewEvidence(np.where(valid, probabilities, np.float32(0)), valid | seen, valid & ~seen)


def join_specs(one: UnitSpec, other: UnitSpec) -> UnitSpec:
    """Return the specification of the combined units.

    Raises:
        UserError: if cameras or grids differ, or a category is in both.
    """
    for name in ("camera", "ego", "obstacles", "valid_threshold", "valid_kernel"):
        if getattr(one, name) != getattr(other, name):
            raise UserError(
                f"units: got the {name} {getattr(one, name)} of {', '.join(one.categories)} and "
                f"{getattr(other, name)} of {', '.join(other.categories)}, expected equal values; use units that were "
                "trained with the same configuration"
            )
    per_category = ("categories", "colours", "thresholds")
    return replace(one, **{name: getattr(one, name) + getattr(other, name) for name in per_category})
