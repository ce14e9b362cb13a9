"""The semantic mapper: a robot's images with poses in, a semantic map out. Numpy, numba and OpenCV only.

Each frame is brought into the camera that the units were trained with, its depth projected, the units asked, and
what they say about the cells registered, side by side with occupancy.
"""

import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

from imagination.geometry.grid import Grid
from imagination.geometry.image_alignment import Alignment
from imagination.geometry.morphology import close, dilate, kernel_cells
from imagination.geometry.pose import Pose
from imagination.geometry.projection import project_depth
from imagination.geometry.rgbd import Intrinsics, Placement, RgbdCamera
from imagination.mapping import map_io
from imagination.mapping.map_io import LoadedLayer
from imagination.mapping.mapper import CHUNK, Mapper
from imagination.mapping.predictor import ImaginationModule, Observation, valid_imagination
from imagination.mapping.semantic_map import UNKNOWN, Maps
from imagination.mapping.update_rules import MovingAverage, UpdateRule
from imagination.utils.errors import UserError, check_range

OCCUPANCY = "occupancy"
"""Name of the layer beside the categories'."""


DASHES = 0.4
"""Metres between two occupied cells of a view, between which nothing is called free; doors are wider."""


@dataclass(frozen=True)
class Limits:
    """How far a robot's camera may be from the one that the units were trained with, before it is an error.

    Attributes:
        field_of_view: horizontal, degrees.
        vertical_field_of_view: degrees; sensors see less of it than square images do.
        resolution: how many times fewer pixels a degree; more of them are averaged.
        mount_height: metres.
        tilt: pitch and roll, degrees.
    """

    field_of_view: float = 40.0
    vertical_field_of_view: float = 50.0
    resolution: float = 4.0
    mount_height: float = 0.5
    tilt: float = 35.0


CLOSE = Limits(2.0, 2.0, 1.1, 0.05, 2.0)
"""Differences up to these are not worth a warning."""


class Update(NamedTuple):
    """What became of a frame.

    Attributes:
        pose: of the robot.
        rgb, depth: as the units' camera would have taken them.
        occupied, seen: the depth's projection.
        probabilities: what the units imagine.
        mask: cells about which they have something to say.
        outside: cells with something to say that lie outside a map of fixed size.
    """

    pose: Pose
    rgb: UInt8[np.ndarray, "h w 3"]
    depth: Float32[np.ndarray, "h w"]
    occupied: Bool[np.ndarray, "v v"]
    seen: Bool[np.ndarray, "v v"]
    probabilities: Float32[np.ndarray, "c v v"]
    mask: Bool[np.ndarray, "c v v"]
    outside: int


class SemanticMapper:
    """Builds a semantic map from frames.

    Args:
        module: the trained units.
        camera: the robot's; the units' own if None.
        rule: of registration; the moving average with factor 0.9 if None.
        grid: of the map, of the units' resolution; if None the map grows with what the robot sees.
        floor_height: world z of the floor, metres.
        frame: id of the world's frame, written into the map.
        limits: how far the camera may be from the units'.
        start: occupancy to start from.
        threshold: probability from which a cell belongs to an object; each category's own if None.

    Raises:
        UserError: if the camera is too far from the units', the grid's resolution is not theirs, or the threshold is
            out of range.

    Attributes:
        frames: registered so far.
    """

    def __init__(
        self,
        module: ImaginationModule,
        camera: RgbdCamera | None = None,
        rule: UpdateRule | None = None,
        grid: Grid | None = None,
        floor_height: float = 0.0,
        frame: str = "map",
        limits: Limits | None = None,
        start: LoadedLayer | None = None,
        threshold: float | None = None,
    ) -> None:
        self.module, self.spec = module, module.spec
        self.camera = camera or RgbdCamera.of(self.spec.camera)
        self.floor_height, self.frame, self.limits = floor_height, frame, limits or Limits()
        self.grows, self.frames = grid is None, 0
        self._thresholds = self.spec.thresholds
        if threshold is not None:
            check_range("threshold", threshold, 0.0, 1.0, open_low=True)
            self._thresholds = (float(threshold),) * len(self.spec.categories)
        self._rule, self._start = rule or MovingAverage(), start
        self._alignment = Alignment(self.camera, self.spec.camera)
        self._warned: set[str] = set()
        self._check_intrinsics()
        self._mapper: Mapper | None = None
        if grid is not None:
            self._begin(grid)
        elif start is not None:
            self._begin(_chunks(self.spec.ego.resolution, *_corners(start.grid)))

    def update(
        self,
        rgb: UInt8[np.ndarray, "h w 3"],
        depth: Float32[np.ndarray, "k l"],
        pose: Pose | Float64[np.ndarray, "4 4"],
    ) -> Update:
        """Register one frame.

        Args:
            rgb: colour image.
            depth: metres along the optical axis, 0 where nothing returned.
            pose: of the robot; or of the colour camera, the transform from its optical frame to the world's.

        Raises:
            UserError: on images of a wrong type or size, depth or a pose that is not finite, or a camera too far from
                the units'. The map stays as it was.
        """
        _check_images(rgb, depth)
        if isinstance(pose, Pose):
            pose = self.camera.to_world(pose, self.floor_height)
        place = Placement.of(pose, self.floor_height)
        self._check_placement(place)
        known = self.spec
        level = known.camera.to_world(Pose(0.0, 0.0, place.pose.theta))
        rgb, depth = self._alignment(rgb, depth, level[:3, :3].T @ pose[:3, :3])
        camera = replace(known.camera, mount_height=place.mount_height)
        view = project_depth(depth, camera, known.ego, known.obstacles)
        probabilities = self.module(Observation(rgb, depth, view.occupied, view.seen, place.mount_height))
        said = valid_imagination(
            probabilities, view.seen[None], known.valid_threshold, known.valid_kernel, known.ego.resolution
        )
        values = np.concatenate([view.occupied[None].astype(np.float32), said.values])
        free = view.seen & ~around(view.occupied, known.ego.resolution)
        mask = np.concatenate([(view.occupied | free)[None], said.mask])
        mapper = self._mapper_at(place.pose)
        outside = 0 if self.grows else mapper.outside(mask, place.pose)
        imagined = np.concatenate([np.zeros_like(view.seen)[None], said.mask & ~view.seen])
        mapper.register(values, mask, place.pose, imagined)
        self.frames += 1
        return Update(place.pose, rgb, depth, view.occupied, view.seen, probabilities, said.mask, outside)

    @property
    def maps(self) -> Maps:
        """The map so far; its arrays are the mapper's own and change with the next frame.

        Raises:
            UserError: if there has been no frame yet.
        """
        if self._mapper is None:
            raise UserError("map: got no frame yet, expected at least one update")
        mapper = self._mapper
        values, written = mapper.probabilities, mapper.written
        about = mapper.grid, self.frame, self.spec.categories, self._thresholds
        return Maps(*about, values[1:], written[1:], values[0], written[0])

    def save(self, folder: str | Path) -> None:
        """Write the map in all formats; see `imagination.mapping.map_io`.

        Args:
            folder: made if it is not there.

        Raises:
            UserError: if there has been no frame yet, or the folder cannot be written.
        """
        map_io.save_maps(Path(folder), self.maps, self.spec.colours)

    def _mapper_at(self, pose: Pose) -> Mapper:
        """The global map, with room for a view from `pose` where it may grow."""
        if self._mapper is None:
            here = np.array([[pose.x, pose.y]])
            self._begin(_chunks(self.spec.ego.resolution, here, here))
        assert self._mapper is not None, "it has just begun"
        if self.grows:
            self._mapper.cover(pose)
        return self._mapper

    def _begin(self, grid: Grid) -> None:
        layers = [OCCUPANCY, *self.spec.categories]
        self._mapper = Mapper(grid, self.spec.ego, layers, self._rule)
        if self._start is not None:
            layer = map_io.fit(self._start, grid)
            known = self._start.grid.to_points(np.argwhere(self._start.layer != UNKNOWN))
            if lost := np.count_nonzero(~grid.inside(grid.to_cells(known))):
                warnings.warn(
                    f"start: {lost} of its {len(known)} known cells lie outside the map of fixed size and are lost; "
                    "enlarge or move it (extent, centre)",
                    stacklevel=3,
                )
            self._mapper.write(0, layer.astype(np.float32) / 100, layer != UNKNOWN)

    def _check_intrinsics(self) -> None:
        """Compare what the robot's cameras see with what the units' did."""
        theirs, limits = Intrinsics.of(self.spec.camera), self.limits
        for kind, ours in (("colour", self.camera.colour), ("depth", self.camera.depth)):
            if ours is None:
                continue
            angles = np.rad2deg([ours.fields_of_view, theirs.fields_of_view]).T.tolist()
            keys = ("horizontal", "field_of_view"), ("vertical", "vertical_field_of_view")
            for (axis, key), (got, trained) in zip(keys, angles, strict=True):
                told = f"{axis} field of view: the robot's {kind} camera has {got:.1f} degrees, "
                told += f"the units' {trained:.1f}"
                if abs(got - trained) > getattr(limits, key):
                    raise UserError(
                        f"{told}; expected at most {getattr(limits, key)} apart; train for this camera "
                        f"(camera.field_of_view) or raise limits.{key}"
                    )
                if abs(got - trained) > getattr(CLOSE, key):
                    warnings.warn(f"{told}; what only one of them sees is left out", stacklevel=3)
            got, trained = np.deg2rad([min(abs(ours.fx), abs(ours.fy)), theirs.fx]).tolist()
            told = f"resolution: the robot's {kind} camera has {got:.2f} pixels a degree, the units' {trained:.2f}"
            if trained > limits.resolution * got:
                raise UserError(
                    f"{told}; expected at most {limits.resolution} times fewer; record larger images, or raise "
                    "limits.resolution"
                )
            if trained > CLOSE.resolution * got:
                warnings.warn(f"{told}; the image is magnified", stacklevel=3)

    def _check_placement(self, place: Placement) -> None:
        """Compare where the camera sits with where the units' did."""
        theirs = self.spec.camera
        for name, got, trained, limit, little, unit in (
            (
                "mount_height",
                place.mount_height,
                theirs.mount_height,
                self.limits.mount_height,
                CLOSE.mount_height,
                "m",
            ),
            (
                "pitch",
                *np.rad2deg([place.pitch, theirs.pitch]).tolist(),
                self.limits.tilt,
                CLOSE.tilt,
                "degrees",
            ),
            (
                "roll",
                *np.rad2deg([place.roll, theirs.roll]).tolist(),
                self.limits.tilt,
                CLOSE.tilt,
                "degrees",
            ),
        ):
            told = f"{name}: the robot's camera is at {got:.2f} {unit}, the units' at {trained:.2f}"
            if not abs(got - trained) <= limit:
                raise UserError(
                    f"{told}; expected at most {limit} apart; check the poses' frame and the floor's height, train for "
                    "this camera, or raise the limit"
                )
            if abs(got - trained) > little and name not in self._warned:
                self._warned.add(name)
                warnings.warn(f"{told}; the image is brought there as far as it can be", stacklevel=3)


def _check_images(rgb: np.ndarray, depth: np.ndarray) -> None:
    """Refuse images of another type, such as depth in whole millimetres, that would be read as something else."""
    if rgb.dtype != np.uint8 or rgb.ndim != 3 or rgb.shape[2] != 3:
        raise UserError(
            f"rgb: got {rgb.dtype} of shape {rgb.shape}, expected uint8 of shape (height, width, 3)"
        )
    if depth.dtype != np.float32 or depth.ndim != 2:
        raise UserError(
            f"depth: got {depth.dtype} of shape {depth.shape}, expected float32 of shape (height, width), in metres; "
            "of 16-bit millimetres: depth.astype(np.float32) / 1000"
        )


def around(occupied: Bool[np.ndarray, "v v"], resolution: float) -> Bool[np.ndarray, "v v"]:
    """Cells that a view does not call free: occupied ones, those between two that are close, and those beside them.

    Seen aslant, a wall comes in dashes, as far apart as pixels are there, with floor at its foot between them; views
    from afar would erase it.

    Args:
        occupied: cells of one view.
        resolution: metres per cell.
    """
    return dilate(close(occupied, kernel_cells(DASHES, resolution)), 3)


def _corners(grid: Grid) -> tuple[Float64[np.ndarray, "1 2"], Float64[np.ndarray, "1 2"]]:
    low = np.array([grid.origin])
    return low, low + grid.resolution * np.array([[grid.columns, grid.rows]])


def _chunks(resolution: float, low: Float64[np.ndarray, "1 2"], high: Float64[np.ndarray, "1 2"]) -> Grid:
    """Whole chunks of cells from one corner to the other; they lie where they do whatever comes first."""
    size = CHUNK * resolution
    first, last = np.floor(low[0] / size), np.floor(high[0] / size)
    columns, rows = ((last - first + 1) * CHUNK).astype(int).tolist()
    x, y = (first * size).tolist()
    return Grid(resolution, rows, columns, (x, y))
