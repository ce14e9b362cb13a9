"""Floor plans: areas, rooms without overlap, and doors that connect all rooms."""

import numpy as np
import pytest

from imagination.scenes.procedural.floor_plan.plan import OUTSIDE, WALL, Plan
from imagination.scenes.procedural.floor_plan.plan_generator import draw_plan

PLANS = [draw_plan(np.random.default_rng(seed)) for seed in range(120)]


def test_areas_span_the_range() -> None:
    areas = [plan.area for plan in PLANS]
    assert 40 <= min(areas) < 55
    assert 120 < max(areas) <= 150


def test_every_home_has_living_room_and_bedroom_and_all_kinds_occur() -> None:
    assert all({"living", "bedroom"} <= {room.kind for room in plan.rooms} for plan in PLANS)
    kinds = {room.kind for plan in PLANS for room in plan.rooms}
    assert kinds == {"living", "dining", "kitchen", "bedroom", "office", "bathroom", "corridor"}


@pytest.mark.parametrize("plan", PLANS[::6])
def test_rooms_stand_a_wall_apart(plan: Plan) -> None:
    for number, room in enumerate(plan.rooms):
        for other in plan.rooms[:number]:
            apart_x = max(room.x0 - other.x1, other.x0 - room.x1)
            apart_y = max(room.y0 - other.y1, other.y0 - room.y1)
            assert max(apart_x, apart_y) >= WALL - 1e-9


@pytest.mark.parametrize("plan", PLANS[::6])
def test_doors_connect_all_rooms(plan: Plan) -> None:
    reached, queue = {0}, [0]
    while queue:
        number = queue.pop()
        for opening in plan.openings_of(number):
            if opening.kind in ("door", "passage"):
                new = set(opening.rooms) - reached
                reached |= new
                queue += new
    assert reached == set(range(len(plan.rooms)))


@pytest.mark.parametrize("plan", PLANS[::6])
def test_openings_lie_within_the_walls_of_both_rooms(plan: Plan) -> None:
    assert sum(opening.kind == "entrance" for opening in plan.openings) <= 1
    for opening in plan.openings:
        width = opening.end - opening.start
        assert width >= {"door": 0.85, "passage": 1.0, "window": 0.5, "entrance": 0.95}[opening.kind] - 1e-9
        assert 0 <= opening.low < opening.high < plan.ceiling
        for number in set(opening.rooms) - {OUTSIDE}:
            room = plan.rooms[number]
            low, high, sides = (
                (room.x0, room.x1, (room.y0, room.y1))
                if opening.axis == 0
                else (room.y0, room.y1, (room.x0, room.x1))
            )
            assert low <= opening.start < opening.end <= high
            assert min(abs(opening.at - side) for side in sides) == pytest.approx(WALL / 2)
            for other in plan.openings_of(number):
                if other is not opening and (other.axis, other.at) == (opening.axis, opening.at):
                    assert other.end <= opening.start or other.start >= opening.end
