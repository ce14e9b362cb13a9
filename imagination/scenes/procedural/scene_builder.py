"""Builder of one home: a scene with floor plan, building and furniture."""

from functools import partial

import numpy as np
from jaxtyping import Float

from imagination.scenes.building_blocks.assembly import assemble_scene
from imagination.scenes.building_blocks.furniture_source import SOURCE, Furniture
from imagination.scenes.building_blocks.pieces import Placed
from imagination.scenes.categories import CategoryTable
from imagination.scenes.procedural.floor_plan.building import build_building
from imagination.scenes.procedural.floor_plan.plan import Plan
from imagination.scenes.procedural.floor_plan.plan_generator import draw_plan
from imagination.scenes.procedural.furnishing.room_rules import furnish
from imagination.scenes.procedural.furniture.procedural_furniture import Stock
from imagination.scenes.scene import FreeSpace, Lighting, Scene
from imagination.scenes.source import Split
from imagination.utils.errors import UserError

STREAMS: dict[Split, int] = {"train": 0, "val": 1, "test": 3}
"""Random streams of the splits in a home's seed. Stream 2 is retired: its test homes were used to select settings."""

ATTEMPTS = 12
"""Maximum number of attempts to draw a home; the first nearly always succeeds."""
REQUIRED: tuple[frozenset[str], ...] = (
    frozenset({"chair"}),
    frozenset({"dining_table", "desk"}),
    frozenset({"double_bed", "single_bed", "bunk_bed"}),
)
"""Sets of labels; every home contains at least one label of each set."""
MIN_FREE_FRACTION = 0.08
"""Minimum fraction of each room's floor area that must be free and reachable."""


def build_home(
    name: str,
    seed: int,
    split: Split,
    number: int,
    categories: CategoryTable,
    robot_radius: float,
    furniture_source: Furniture,
) -> Scene:
    """Build a home; the result depends on the arguments only.

    Raises:
        UserError: if no attempt gives a home in which the robot reaches every room.
    """
    for attempt in range(ATTEMPTS):
        rng = np.random.default_rng([seed, STREAMS[split], number, attempt])
        plan = draw_plan(rng)
        stock = Stock(furniture_source, split, rng)
        furniture = furnish(plan, stock, robot_radius)
        labels = {obj.piece.label for obj in furniture}
        if not all(labels & alternatives for alternatives in REQUIRED):
            continue
        building = Placed(build_building(plan, stock.palette, rng))
        yaw = float(rng.uniform(-np.pi, np.pi))
        lighting = _lighting(rng)
        centre = _centre(building.within(0.0, 0.0, yaw))
        placed = [obj.within(-centre[0], -centre[1], yaw) for obj in (building, *furniture)]
        category_of = partial(categories.of_label, SOURCE)
        try:
            scene = assemble_scene(name, placed, category_of, robot_radius, lighting, plan.ceiling)
        except UserError:
            continue
        if _reaches_all(scene.free_space, plan, placed[0]):
            return scene
    raise UserError(
        f"{name}: got no home that a robot of radius {robot_radius} m can traverse in {ATTEMPTS} attempts; "
        "use another seed or a smaller radius"
    )


def _centre(building: Placed) -> Float[np.ndarray, "2"]:
    """Return the centre x, y of the bounding box of a building."""
    points = building.points()[:, :2]
    return np.asarray((points.min(axis=0) + points.max(axis=0)) / 2)


def _reaches_all(free: FreeSpace, plan: Plan, building: Placed) -> bool:
    """Return whether the free space contains MIN_FREE_FRACTION of each room."""
    rows, columns = np.nonzero(free.mask)
    points = free.grid.to_points(np.stack([rows, columns], axis=-1)) - (building.x, building.y)
    cos, sin = np.cos(building.yaw), np.sin(building.yaw)
    local = points @ np.array([[cos, -sin], [sin, cos]])  # back into the plan's frame
    cell_area = free.grid.resolution**2
    for room in plan.rooms:
        inside = (local >= (room.x0, room.y0)) & (local <= (room.x1, room.y1))
        if inside.all(axis=1).sum() * cell_area < MIN_FREE_FRACTION * room.area:
            return False
    return True


def _lighting(rng: np.random.Generator) -> Lighting:
    """Draw light from above and from two sides, with random colour temperature and brightness."""
    warm = rng.uniform(-1, 1)
    tint = np.array([1 + 0.06 * warm, 1.0, 1 - 0.09 * warm])
    turn = rng.uniform(0, 2 * np.pi) + np.array([0.0, 2.2])
    directions = [
        [np.cos(angle), np.sin(angle), height]
        for angle, height in zip(turn, rng.uniform(0.4, 1.0, 2), strict=True)
    ]
    directions.append([0.15, -0.1, 1.0])
    unit = np.array(directions) / np.linalg.norm(directions, axis=1, keepdims=True)
    strengths = rng.uniform([0.28, 0.16, 0.08], [0.46, 0.32, 0.18])
    ambient = rng.uniform(0.45, 0.60) * tint
    red, green, blue = ambient.tolist()
    return Lighting(
        (red, green, blue), unit.astype(np.float32), (strengths[:, None] * tint).astype(np.float32)
    )
