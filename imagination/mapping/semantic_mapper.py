"""Semantic mapper: builds a semantic map from a robot's images and poses with NumPy, numba and OpenCV only.

Each frame is warped into the camera that the units were trained with and its depth is projected. Then the units
predict, and the evidence is registered together with occupancy.
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
from imagination.mapping.predictor import MapPredictor, Observation, valid_imagination
from imagination.mapping.semantic_map import UNKNOWN, Maps
from imagination.mapping.update_rules import MovingAverage, UpdateRule
from imagination.utils.errors import UserError, check_range

OCCUPANCY = "occupancy"
"""Name of the layer that precedes the category layers."""

DASHES = 0.4
"""Largest gap between two occupied cells of a view in which no cell is marked as free, metres; doors are wider."""


@dataclass(frozen=True)
class CameraDifference:
    """Difference between the robot's camera and the camera that the units were trained with.

    Attributes:
        field_of_view: horizontal field of view, degrees.
        vertical_field_of_view: vertical field of view, degrees; it is smaller for most sensors than for square images.
        resolution: pixels per degree of the training camera, divided by those of the robot's camera.
        mount_height: height above the floor, metres.
        tilt: pitch and roll, degrees.
    """

    field_of_view: float
    vertical_field_of_view: float
    resolution: float
    mount_height: float
    tilt: float


MAX_DIFFERENCE = CameraDifference(
    field_of_view=40.0, vertical_field_of_view=50.0, resolution=4.0, mount_height=0.5, tilt=35.0
)
"""Largest difference at which frames are mapped; beyond it the camera or the frame is refused."""

WARNING_DIFFERENCE = CameraDifference(
    field_of_view=2.0, vertical_field_of_view=2.0, resolution=1.1, mount_height=0.05, tilt=2.0
)
"""Difference beyond which a warning is issued."""


class Update(NamedTuple):
    """Result of registering one frame.

    Attributes:
        pose: pose of the robot.
        rgb, depth: images warped into the units' camera.
        occupied, seen: projection of the depth.
        probabilities: predictions of the units.
        mask: cells with evidence of each category.
        outside: number of cells with evidence outside a map of fixed size.
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
        predictor: trained units.
        camera: camera of the robot; the units' camera if None.
        rule: update rule of registration; the moving average with factor 0.9 if None.
        grid: grid of a map of fixed size, of the units' resolution; the map extends with the observed area if None.
        floor_height: world z of the floor, metres.
        frame: id of the world frame, stored in the map.
        start: occupancy map to start from.
        threshold: probability from which a cell belongs to an object; the threshold of each category if None.

    Raises:
        UserError: if the camera differs from the units' camera by more than `MAX_DIFFERENCE`, the grid has another
            resolution than the units, or the threshold is out of range.

    Attributes:
        frames: number of frames registered so far.
    """

    def __init__(
        self,
        predictor: MapPredictor,
        camera: RgbdCamera | None = None,
        rule: UpdateRule | None = None,
        grid: Grid | None = None,
        floor_height: float = 0.0,
        frame: str = "map",
        start: LoadedLayer | None = None,
        threshold: float | None = None,
    ) -> None:
        self.predictor, self.spec = predictor, predictor.spec
        self.camera = camera or RgbdCamera.of(self.spec.camera)
        self.floor_height, self.frame = floor_height, frame
        self.extensible, self.frames = grid is None, 0
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
            depth: metres along the optical axis, 0 without a return.
            pose: pose of the robot, or the transform from the colour camera's optical frame to the world frame.

        Raises:
            UserError: if an image has the wrong type or size, depth or pose are not finite, or the camera's placement
                differs by more than `MAX_DIFFERENCE`. The map does not change.
        """
        _check_images(rgb, depth)
        if isinstance(pose, Pose):
            pose = self.camera.to_world(pose, self.floor_height)
        place = Placement.of(pose, self.floor_height)
        self._check_placement(place)
        spec = self.spec
        level = spec.camera.to_world(Pose(0.0, 0.0, place.pose.theta))
        rgb, depth = self._alignment(rgb, depth, level[:3, :3].T @ pose[:3, :3])
        camera = replace(spec.camera, mount_height=place.mount_height)
        view = project_depth(depth, camera, spec.ego, spec.obstacles)
        probabilities = self.predictor(Observation(rgb, depth, view.occupied, view.seen, place.mount_height))
        evidence = valid_imagination(
            probabilities, view.seen[None], spec.valid_threshold, spec.valid_kernel, spec.ego.resolution
        )
        values = np.concatenate([view.occupied[None].astype(np.float32), evidence.values])
        free = view.seen & ~near_obstacles(view.occupied, spec.ego.resolution)
        mask = np.concatenate([(view.occupied | free)[None], evidence.mask])
        mapper = self._mapper_at(place.pose)
        outside = 0 if self.extensible else mapper.outside(mask, place.pose)
        imagined = np.concatenate([np.zeros_like(view.seen)[None], evidence.mask & ~view.seen])
        mapper.register(values, mask, place.pose, imagined)
        self.frames += 1
        return Update(place.pose, rgb, depth, view.occupied, view.seen, probabilities, evidence.mask, outside)

    @property
    def maps(self) -> Maps:
        """Current semantic map; its arrays are shared with the mapper and change with the next frame.

        Raises:
            UserError: if no frame was registered yet.
        """
        if self._mapper is None:
            raise UserError("map: got no frame yet, expected at least one update")
        mapper = self._mapper
        values, written = mapper.probabilities, mapper.written
        metadata = mapper.grid, self.frame, self.spec.categories, self._thresholds
        return Maps(*metadata, values[1:], written[1:], values[0], written[0])

    def save(self, folder: str | Path) -> None:
        """Write the map in all formats; see `imagination.mapping.map_io`.

        Args:
            folder: output folder, created if it does not exist.

        Raises:
            UserError: if no frame was registered yet, or the folder is not writable.
        """
        map_io.save_maps(Path(folder), self.maps, self.spec.colours)

    def _mapper_at(self, pose: Pose) -> Mapper:
        """Return the global map, extended to the reach of a view from `pose` unless its size is fixed."""
        if self._mapper is None:
            position = np.array([[pose.x, pose.y]])
            self._begin(_chunks(self.spec.ego.resolution, position, position))
        assert self._mapper is not None, "created by _begin"
        if self.extensible:
            self._mapper.cover(pose)
        return self._mapper

    def _begin(self, grid: Grid) -> None:
        layers = [OCCUPANCY, *self.spec.categories]
        self._mapper = Mapper(grid, self.spec.ego, layers, self._rule)
        if self._start is not None:
            layer = map_io.resample_layer(self._start, grid)
            known = self._start.grid.to_points(np.argwhere(self._start.layer != UNKNOWN))
            if lost := np.count_nonzero(~grid.inside(grid.to_cells(known))):
                warnings.warn(
                    f"start: {lost} of the {len(known)} known cells are outside the map of fixed size and are lost; "
                    "enlarge or move the map (extent, centre)",
                    stacklevel=3,
                )
            self._mapper.write(0, layer.astype(np.float32) / 100, layer != UNKNOWN)

    def _check_intrinsics(self) -> None:
        """Compare fields of view and resolution of the robot's cameras with the units' camera."""
        training = Intrinsics.of(self.spec.camera)
        for kind, robot in (("colour", self.camera.colour), ("depth", self.camera.depth)):
            if robot is None:
                continue
            angles = np.rad2deg([robot.fields_of_view, training.fields_of_view]).T.tolist()
            keys = ("horizontal", "field_of_view"), ("vertical", "vertical_field_of_view")
            for (axis, key), (got, trained) in zip(keys, angles, strict=True):
                message = f"{axis} field of view: the robot's {kind} camera has {got:.1f} degrees, "
                message += f"the units' camera {trained:.1f}"
                limit = getattr(MAX_DIFFERENCE, key)
                if abs(got - trained) > limit:
                    raise UserError(
                        f"{message}; expected a difference of at most {limit}; train units for this camera "
                        "(camera.field_of_view)"
                    )
                if abs(got - trained) > getattr(WARNING_DIFFERENCE, key):
                    warnings.warn(f"{message}; only the common part is used", stacklevel=3)
            got, trained = np.deg2rad([min(abs(robot.fx), abs(robot.fy)), training.fx]).tolist()
            message = f"resolution: the robot's {kind} camera has {got:.2f} pixels per degree, "
            message += f"the units' camera {trained:.2f}"
            if trained > MAX_DIFFERENCE.resolution * got:
                raise UserError(
                    f"{message}; expected a ratio of at most {MAX_DIFFERENCE.resolution}; record larger images"
                )
            if trained > WARNING_DIFFERENCE.resolution * got:
                warnings.warn(f"{message}; the image is magnified", stacklevel=3)

    def _check_placement(self, place: Placement) -> None:
        """Compare height and tilt of the robot's camera with the units' camera."""
        training = self.spec.camera
        pitches, rolls = np.rad2deg([[place.pitch, training.pitch], [place.roll, training.roll]]).tolist()
        heights = place.mount_height, training.mount_height
        for name, (got, trained), key, unit in (
            ("mount_height", heights, "mount_height", "m"),
            ("pitch", pitches, "tilt", "degrees"),
            ("roll", rolls, "tilt", "degrees"),
        ):
            limit = getattr(MAX_DIFFERENCE, key)
            message = f"{name}: the robot's camera has {got:.2f} {unit}, the units' camera {trained:.2f}"
            if not abs(got - trained) <= limit:
                raise UserError(
                    f"{message}; expected a difference of at most {limit}; check the frame of the poses and the floor "
                    "height, or train units for this camera"
                )
            if abs(got - trained) > getattr(WARNING_DIFFERENCE, key) and name not in self._warned:
                self._warned.add(name)
                warnings.warn(f"{message}; the image is warped as far as possible", stacklevel=3)


def _check_images(rgb: np.ndarray, depth: np.ndarray) -> None:
    """Check types and shapes; depth in integer millimetres, for example, would be misread as metres."""
    if rgb.dtype != np.uint8 or rgb.ndim != 3 or rgb.shape[2] != 3:
        raise UserError(
            f"rgb: got {rgb.dtype} of shape {rgb.shape}, expected uint8 of shape (height, width, 3)"
        )
    if depth.dtype != np.float32 or depth.ndim != 2:
        raise UserError(
            f"depth: got {depth.dtype} of shape {depth.shape}, expected float32 of shape (height, width), in metres; "
            "convert 16-bit millimetres with depth.astype(np.float32) / 1000"
        )


def near_obstacles(occupied: Bool[np.ndarray, "v v"], resolution: float) -> Bool[np.ndarray, "v v"]:
    """Return cells that a view does not mark as free: occupied cells, gaps between close ones, and all neighbours.

    A wall seen at a grazing angle is projected as dashes with observed floor between them, because neighbouring pixels
    are far apart there; without this mask, distant views would erase the wall.

    Args:
        occupied: occupied cells of one view.
        resolution: metres per cell.
    """
    return dilate(close(occupied, kernel_cells(DASHES, resolution)), 3)


def _corners(grid: Grid) -> tuple[Float64[np.ndarray, "1 2"], Float64[np.ndarray, "1 2"]]:
    low = np.array([grid.origin])
    return low, low + grid.resolution * np.array([[grid.columns, grid.rows]])


def _chunks(resolution: float, low: Float64[np.ndarray, "1 2"], high: Float64[np.ndarray, "1 2"]) -> Grid:
    """Return the grid of whole chunks that covers two corners; chunk borders do not depend on the first pose."""
    size = CHUNK * resolution
    first, last = np.floor(low[0] / size), np.floor(high[0] / size)
    columns, rows = ((last - first + 1) * CHUNK).astype(int).tolist()
    x, y = (first * size).tolist()
    return Grid(resolution, rows, columns, (x, y))
