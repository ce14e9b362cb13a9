"""Families of chairs, tables and beds, and the parameter ranges of their shapes in each split.

The range of every parameter is divided into slices: training uses the middle, validation the slices next to it, and
test both ends. Test furniture is therefore outside the training range in every parameter, but close to it. In
addition, some families are held out for test, and some occur in training only, for variety; these use the whole range.
`styles.families_of` lists them.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple

from imagination.scenes.source import Split


class Interval(NamedTuple):
    """Closed interval."""

    low: float
    high: float


Intervals = tuple[Interval, ...]

SLICES: Mapping[Split, Intervals] = MappingProxyType(
    {
        "train": (Interval(0.24, 0.76),),
        "val": (Interval(0.14, 0.22), Interval(0.78, 0.86)),
        "test": (Interval(0.0, 0.12), Interval(0.88, 1.0)),
    }
)
"""Fractions of a parameter's range that each split draws from."""

ALL_SPLITS: tuple[Split, ...] = ("train", "val", "test")
TEST_ONLY: tuple[Split, ...] = ("test",)
TRAIN_ONLY: tuple[Split, ...] = ("train",)


@dataclass(frozen=True)
class Family:
    """Family of chairs, tables or beds.

    Attributes:
        name: unique name.
        label: label of its objects in a scene.
        ranges: whole range of each parameter, in metres unless the builder defines another unit.
        options: optional features of a style.
        splits: splits in which the family occurs.
    """

    name: str
    label: str
    ranges: Mapping[str, tuple[float, float]]
    options: tuple[str, ...] = ()
    splits: tuple[Split, ...] = ALL_SPLITS

    def intervals(self, split: Split) -> dict[str, Intervals]:
        """Return the intervals of each parameter in a split; families of a single split use the whole range."""
        slices = SLICES[split] if self.splits == ALL_SPLITS else (Interval(0.0, 1.0),)
        return {
            name: tuple(
                Interval(low + part.low * (high - low), low + part.high * (high - low)) for part in slices
            )
            for name, (low, high) in self.ranges.items()
        }


SEAT = {
    "width": (0.39, 0.51),
    "depth": (0.38, 0.48),
    "seat": (0.42, 0.49),
    "back": (0.34, 0.60),
    "rake": (0.03, 0.22),
}
"""Ranges of a dining chair: seat width, depth and height, back height above the seat, rake of the back (radians)."""
WOODEN = {**SEAT, "leg": (0.026, 0.050), "splay": (0.0, 0.05)}
SWIVEL = {
    "width": (0.43, 0.54),
    "depth": (0.42, 0.52),
    "seat": (0.43, 0.53),
    "star": (0.27, 0.36),
    "rake": (0.05, 0.25),
}
EASY = {
    "width": (0.48, 0.66),
    "depth": (0.48, 0.60),
    "seat": (0.36, 0.46),
    "arm": (0.07, 0.18),
    "rake": (0.10, 0.30),
}
TOP = {"length": (1.05, 2.30), "depth": (0.72, 1.05), "height": (0.71, 0.78), "thick": (0.02, 0.055)}
WORK = {"length": (0.95, 1.75), "depth": (0.52, 0.82), "height": (0.70, 0.78), "thick": (0.018, 0.045)}
LOW = {"length": (0.70, 1.35), "depth": (0.45, 0.75), "height": (0.30, 0.48), "thick": (0.015, 0.05)}
DOUBLE = {"width": (1.35, 2.00), "length": (1.92, 2.12), "mattress": (0.40, 0.62), "board": (0.75, 1.30)}
SINGLE = {"width": (0.80, 1.15), "length": (1.85, 2.08), "mattress": (0.38, 0.58), "board": (0.65, 1.10)}

FAMILIES: tuple[Family, ...] = (
    Family("slat_back", "chair", {**WOODEN, "slat": (0.018, 0.060), "gap": (0.025, 0.070)}, ("stretchers", "pad")),
    Family("ladder_back", "chair", {**WOODEN, "slat": (0.040, 0.100), "gap": (0.050, 0.120)}, ("stretchers", "arms")),
    Family("panel_back", "chair", {**WOODEN, "gap": (0.02, 0.18)}, ("pad", "arms", "stretchers")),
    Family("upholstered", "chair", {**WOODEN, "pad": (0.05, 0.13)}),
    Family("sled", "chair", {**SEAT, "tube": (0.010, 0.018), "gap": (0.04, 0.20)}, ("arms", "pad")),
    Family("shell", "chair", {**SEAT, "bowl": (0.03, 0.13), "leg": (0.010, 0.022), "splay": (0.03, 0.11)}, ("arms",)),
    Family("tulip", "chair", {**SEAT, "bowl": (0.03, 0.13), "foot": (0.20, 0.27), "stem": (0.025, 0.05)}, ("pad",)),
    Family("spindle_back", "chair", {**WOODEN, "slat": (0.010, 0.020), "gap": (0.035, 0.065)}, ("arms",), TEST_ONLY),
    Family("cantilever", "chair", {**SEAT, "tube": (0.010, 0.016), "gap": (0.05, 0.2)}, ("arms", "pad"), TEST_ONLY),
    Family("bistro", "chair", {**SEAT, "tube": (0.010, 0.016), "hoop": (0.3, 0.8), "splay": (0.01, 0.06)}, (),
           TRAIN_ONLY),
    Family("folding", "chair", {**SEAT, "slat": (0.04, 0.09), "leg": (0.018, 0.032)}, (), TRAIN_ONLY),
    Family("task_swivel", "office_chair", {**SWIVEL, "back": (0.38, 0.62), "gap": (0.04, 0.18)}, ("armrests",)),
    Family("executive_swivel", "office_chair", {**SWIVEL, "back": (0.58, 0.82), "pad": (0.06, 0.13)}, ("armrests",)),
    Family("bucket_swivel", "office_chair", {**SWIVEL, "back": (0.30, 0.46), "bowl": (0.04, 0.14)}, ("arms",)),
    Family("headrest_swivel", "office_chair", {**SWIVEL, "back": (0.46, 0.6), "gap": (0.03, 0.1)}, (), TEST_ONLY),
    Family("club", "armchair", {**EASY, "back": (0.30, 0.52), "lift": (0.03, 0.14)}, ("pillow",)),
    Family("frame_lounge", "armchair", {**EASY, "back": (0.38, 0.62), "leg": (0.028, 0.055)}, ("pillow",)),
    Family("tub", "armchair", {**EASY, "back": (0.26, 0.44), "lift": (0.05, 0.18)}),
    Family("recliner", "armchair", {**EASY, "back": (0.50, 0.80), "lift": (0.02, 0.10), "rest": (0.0, 0.20)}, (),
           TRAIN_ONLY),
    Family("slipper", "armchair", {"width": (0.52, 0.80), "depth": (0.50, 0.66), "seat": (0.34, 0.46),
           "rake": (0.1, 0.3), "back": (0.34, 0.62), "pad": (0.10, 0.20), "lift": (0.04, 0.20)}, ("pillow",),
           TRAIN_ONLY),
    Family("rocker", "armchair", {**EASY, "back": (0.50, 0.75), "leg": (0.026, 0.045), "slat": (0.03, 0.09)}, ("pad",),
           TRAIN_ONLY),
    Family("wing", "armchair", {**EASY, "back": (0.58, 0.75), "lift": (0.10, 0.18)}, (), TEST_ONLY),
    Family("four_leg_table", "dining_table", {**TOP, "leg": (0.045, 0.10), "apron": (0.05, 0.10)}, ("round_corners",)),
    Family("trestle_table", "dining_table", {**TOP, "leg": (0.05, 0.11), "inset": (0.15, 0.40)}),
    Family("panel_table", "dining_table", {**TOP, "leg": (0.025, 0.06), "inset": (0.0, 0.30)}),
    Family("round_table", "dining_table", {"across": (0.85, 1.45), "height": (0.71, 0.78), "thick": (0.02, 0.05),
           "leg": (0.035, 0.07), "inset": (0.10, 0.24)}),
    Family("pedestal_table", "dining_table", {"across": (0.80, 1.40), "height": (0.71, 0.78), "thick": (0.02, 0.05),
           "stem": (0.04, 0.11), "foot": (0.45, 0.65)}, ("oval",)),
    Family("x_table", "dining_table", {**TOP, "leg": (0.05, 0.09), "inset": (0.12, 0.30)}, (), TEST_ONLY),
    Family("boat_table", "dining_table", {**TOP, "stem": (0.08, 0.14), "foot": (0.5, 0.7)}, (), TEST_ONLY),
    Family("plain_desk", "desk", {**WORK, "leg": (0.03, 0.06)}, ("drawer",)),
    Family("drawer_desk", "desk", {**WORK, "chest": (0.30, 0.46)}, ("two_chests",)),
    Family("panel_desk", "desk", {**WORK, "leg": (0.02, 0.045)}, ("drawer",)),
    Family("corner_desk", "desk", {**WORK, "wing": (0.45, 0.85), "leg": (0.03, 0.06)}),
    Family("hutch_desk", "desk", {**WORK, "hutch": (0.30, 0.55), "leg": (0.02, 0.04)}, (), TEST_ONLY),
    Family("low_table", "coffee_table", {**LOW, "leg": (0.03, 0.07)}, ("shelf",)),
    Family("round_coffee_table", "coffee_table", {"across": (0.60, 1.0), "height": (0.30, 0.50), "thick": (0.015, 0.05),
           "leg": (0.025, 0.05), "splay": (0.0, 0.10)}, ("shelf",)),
    Family("block_table", "coffee_table", {**LOW, "leg": (0.03, 0.08)}),
    Family("hairpin_table", "coffee_table", {**LOW, "leg": (0.008, 0.014)}, ("oval",), TEST_ONLY),
    Family("stand", "side_table", {"across": (0.36, 0.60), "height": (0.45, 0.68), "thick": (0.015, 0.04),
           "stem": (0.02, 0.05)}),
    Family("square_side_table", "side_table", {"across": (0.36, 0.58), "height": (0.42, 0.65), "thick": (0.015, 0.04),
           "leg": (0.025, 0.05)}, ("shelf",)),
    Family("drum", "side_table", {"across": (0.34, 0.55), "height": (0.42, 0.60), "waist": (0.6, 0.9)}, (), TEST_ONLY),
    Family("platform_bed", "double_bed", {**DOUBLE, "lip": (0.02, 0.10), "lift": (0.06, 0.20)}),
    Family("panel_bed", "double_bed", {**DOUBLE, "foot": (0.45, 0.80), "post": (0.05, 0.10)}, ("knobs",)),
    Family("upholstered_bed", "double_bed", {**DOUBLE, "pad": (0.07, 0.16)}, ("wings",)),
    Family("four_poster_bed", "double_bed", {**DOUBLE, "post": (0.05, 0.10), "canopy": (1.85, 2.15)}, (), TEST_ONLY),
    Family("slat_bed", "single_bed", {**SINGLE, "slat": (0.02, 0.06), "gap": (0.05, 0.11)}, ("footboard",)),
    Family("box_bed", "single_bed", {**SINGLE, "lift": (0.02, 0.12)}, ("drawers",)),
    Family("daybed", "single_bed", {**SINGLE, "post": (0.035, 0.08)}),
    Family("sleigh_bed", "single_bed", {**SINGLE, "curl": (0.10, 0.22)}, (), TEST_ONLY),
    Family("bunk_bed", "bunk_bed", {"width": (0.82, 1.08), "length": (1.90, 2.08), "mattress": (0.38, 0.52),
           "upper": (1.28, 1.50), "post": (0.05, 0.09)}, ("drawers",)),
    Family("wide_bunk", "bunk_bed", {"width": (1.05, 1.40), "length": (1.95, 2.10), "mattress": (0.36, 0.48),
           "upper": (1.32, 1.55), "post": (0.06, 0.10)}, (), TEST_ONLY),
)  # fmt: skip
"""All families."""
