"""Shapes of furniture against analytic volumes; each is closed with outward normals."""

from collections import Counter
from itertools import islice

import numpy as np
import pytest

from imagination.scenes.building_blocks import shapes
from imagination.scenes.building_blocks.furniture_source import LABELS, STYLED_LABELS
from imagination.scenes.building_blocks.palette import Palette
from imagination.scenes.building_blocks.pieces import box_uv
from imagination.scenes.building_blocks.shapes import Solid
from imagination.scenes.procedural.furniture.distractors import BUILDERS
from imagination.scenes.procedural.furniture.families import FAMILIES
from imagination.scenes.procedural.furniture.procedural_furniture import STYLED
from imagination.scenes.procedural.furniture.styles import draw_style

HALF_TURN = np.linspace(0, np.pi, 40)
ARC = np.stack(
    [np.stack([np.cos(HALF_TURN), np.sin(HALF_TURN), np.full(40, z)], -1) for z in (0.0, 0.5, 1.0)]
)
SOLIDS = {
    "box": (shapes.box(0.5, 0.4, 0.3), 0.5 * 0.4 * 0.3),
    "prism": (shapes.prism(shapes.rectangle(2.0, 1.0), 0.2, 0.7), 1.0),
    "ellipse": (shapes.prism(shapes.ellipse(2.0, 1.0, 200), 0.0, 1.0), np.pi / 2),
    "rounded": (shapes.prism(shapes.rounded(2.0, 1.0, 0.2, 40), 0.0, 1.0), 2.0 - (4 - np.pi) * 0.04),
    "cone": (shapes.lathe([(1.0, 0.0), (0.5, 1.0)], 200), np.pi / 3 * (1 + 0.5 + 0.25)),
    "tube": (shapes.tube([(0, 0, 0), (0, 0, 1), (0, 0, 2)], 0.1, 100), np.pi * 0.01 * 2),
    "square bar": (shapes.tube([(0, 0, 0), (1, 0, 0)], 0.1, 4), 2 * 0.1**2),
    "cushion": (
        shapes.cushion(1, 1, 1, 0.2, steps=24),
        0.6**3 + 6 * 0.2 * 0.6**2 + np.pi * (3 * 0.6 * 0.04 + 0.032 / 3),
    ),
    "flat cushion": (shapes.cushion(1.0, 0.8, 0.2, 0.001), 0.16),
    "half pipe": (shapes.sheet(ARC, 0.1), np.pi / 2 * (1.0 - 0.81)),
}


def volume(solid: Solid) -> float:
    """Return the volume by the divergence theorem, positive for outward normals."""
    a, b, c = (solid.vertices[solid.faces[:, corner]] for corner in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


@pytest.mark.parametrize("name", SOLIDS)
def test_shape_has_its_volume_and_outward_normals(name: str) -> None:
    solid, expected = SOLIDS[name]
    assert volume(solid) == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("name", SOLIDS)
def test_shape_is_closed(name: str) -> None:
    solid, _ = SOLIDS[name]
    _, corner = np.unique(np.round(solid.vertices, 7), axis=0, return_inverse=True)
    edges = Counter(
        (a, b) for face in corner[solid.faces] for a, b in zip(face, np.roll(face, -1), strict=True) if a != b
    )
    assert all(edges[b, a] == count for (a, b), count in edges.items())


def test_moved_tilts_then_rotates_then_translates() -> None:
    point = Solid(np.array([[0.0, 0.0, 1.0]]), np.zeros((0, 3), int))
    # the tilt takes +z to -y, a quarter turn takes -y to +x
    np.testing.assert_allclose(
        point.moved((5, 6, 7), np.pi / 2, np.pi / 2).vertices, [[6.0, 6.0, 7.0]], atol=1e-12
    )


def test_texture_coordinates_are_in_metres() -> None:
    solid = shapes.box(0.5, 0.4, 0.3)
    uv = box_uv(solid)
    first, second = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    area = np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]) / 2
    assert area.sum() == pytest.approx(2 * (0.5 * 0.4 + 0.5 * 0.3 + 0.4 * 0.3))


@pytest.mark.parametrize("family", FAMILIES, ids=lambda family: family.name)
def test_furniture_stands_on_the_floor_and_has_its_size(family) -> None:
    rng = np.random.default_rng(3)
    palette = Palette(rng)
    drawn = (draw_style(family.label, family.splits[-1], rng) for _ in range(300))
    pieces = [
        STYLED[family.label](style, palette) for style in islice((s for s in drawn if s.family is family), 5)
    ]
    assert len(pieces) == 5
    for piece in pieces:
        width, depth, height = piece.high - piece.low
        assert abs(piece.low[2]) < 0.03
        assert 0.3 < max(width, depth) < 2.8
        assert 0.25 < height < 2.3  # all furniture reaches the heights of obstacles
        assert np.isfinite(piece.uv).all()


def test_every_styled_label_has_families() -> None:
    assert {family.label for family in FAMILIES} == set(STYLED) == set(STYLED_LABELS)
    assert sorted(LABELS) == sorted([*STYLED, *BUILDERS])
