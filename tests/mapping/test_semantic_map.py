"""Outlines of objects, compared with the cells drawn from them."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis.extra.numpy import arrays
from matplotlib.path import Path as Polygon

from imagination.geometry.grid import Grid
from imagination.mapping.map_io import to_geojson
from imagination.mapping.semantic_map import MapObject, Maps
from imagination.utils.errors import UserError

GRID = Grid(0.1, 12, 14, (-0.7, 3.0))


def maps_of(mask: np.ndarray, threshold: float = 0.5) -> Maps:
    values = np.where(mask, np.float32(0.75), np.float32(0.25))[None]
    every = np.ones(mask.shape, np.bool_)
    nothing = np.zeros(mask.shape, np.float32)
    return Maps(GRID, "map", ("chair",), (threshold,), values, every[None], nothing, every)


def shoelace(loop: np.ndarray) -> float:
    x, y = loop.T
    return float(0.5 * (x * np.roll(y, -1) - y * np.roll(x, -1)).sum())


@settings(max_examples=60)
@given(arrays(np.bool_, GRID.shape))
def test_outlines_contain_exactly_their_cells(mask: np.ndarray) -> None:
    found = maps_of(mask).objects(smallest=0.0)
    count, labels = cv2.connectedComponents(mask.astype(np.uint8), connectivity=4)
    assert len(found) == count - 1
    centres = GRID.to_points(np.moveaxis(np.indices(GRID.shape), 0, -1)).reshape(-1, 2)
    drawn = np.zeros(mask.size, int)
    for obj in found:
        inside = Polygon(obj.outline).contains_points(centres)
        for hole in obj.holes:
            inside &= ~Polygon(hole).contains_points(centres)
        drawn += inside
        loops = [obj.outline, *obj.holes]
        assert shoelace(obj.outline) > 0 and all(shoelace(hole) < 0 for hole in obj.holes)
        assert sum(map(shoelace, loops)) == pytest.approx(obj.area) == pytest.approx(0.01 * inside.sum())
        steps = np.concatenate([np.roll(loop, -1, axis=0) - loop for loop in loops])
        assert (np.isclose(steps, 0).sum(axis=1) == 1).all()  # along the axes, no corner twice
        assert obj.confidence == pytest.approx(0.75)
    assert (drawn.reshape(GRID.shape) == mask).all()


def test_an_object_by_hand() -> None:
    mask = np.zeros(GRID.shape, np.bool_)
    mask[2:4, 1:4] = True
    (obj,) = maps_of(mask).objects()
    assert {tuple(np.round(corner, 6)) for corner in obj.outline} == {
        (-0.6, 3.8),
        (-0.3, 3.8),
        (-0.3, 4.0),
        (-0.6, 4.0),
    }
    assert obj.centre == pytest.approx((-0.45, 3.9))
    assert maps_of(mask).objects(smallest=0.07) == []
    assert len(maps_of(mask, 0.75).objects()) == 1 and maps_of(mask, 0.76).objects() == []
    text = to_geojson([obj], "odom")
    ring = text["features"][0]["geometry"]["coordinates"][0]
    assert text["frame"] == "odom" and ring[0] == ring[-1] and len(ring) == 5
    assert text["features"][0]["properties"] == {"category": "chair", "confidence": 0.75, "area": 0.06}


def test_each_category_has_its_threshold() -> None:
    mask = np.zeros(GRID.shape, np.bool_)
    mask[2:4, 1:4] = True
    both = maps_of(mask)
    both = replace(
        both,
        categories=("chair", "bed"),
        thresholds=(0.8, 0.5),
        probabilities=np.repeat(both.probabilities, 2, axis=0),
        written=np.repeat(both.written, 2, axis=0),
    )
    assert [obj.category for obj in both.objects()] == ["bed"]
    assert [obj.category for obj in replace(both, thresholds=(0.7, 0.9)).objects()] == ["chair"]


def test_out_of_range() -> None:
    empty = maps_of(np.zeros(GRID.shape, np.bool_))
    assert empty.objects() == []
    with pytest.raises(UserError, match="threshold: got 0"):
        replace(empty, thresholds=(0.0,))
    with pytest.raises(UserError, match="thresholds: got 2"):
        replace(empty, thresholds=(0.5, 0.5))
    with pytest.raises(UserError, match="category: got 'sofa'"):
        empty.category_layer("sofa")


def test_centre_is_of_the_bounding_box() -> None:
    outline = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 1.0]])
    assert MapObject("chair", outline, [], 0.5, 1.0).centre == (1.0, 0.5)
