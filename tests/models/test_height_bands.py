"""Depth projection by height, compared with a loop and with occupancy."""

import numpy as np
import pytest
import torch

from imagination.geometry.projection import Band, project_depth
from imagination.models.height_bands import HeightBands
from imagination.utils.errors import UserError
from tests.models.test_projected_unit import CAMERA, EGO, random_depth

HEIGHTS = [0.2, 0.5, 0.8, 1.5]


def test_bands_are_those_of_a_loop() -> None:
    depth = random_depth(2)
    bands = HeightBands(CAMERA, EGO, HEIGHTS)(depth).numpy()
    expected = np.zeros_like(bands)
    (centre_u, centre_v), to_robot = CAMERA.principal_point, CAMERA.to_robot()
    for view, v, u in np.argwhere(depth[:, 0].numpy() > 0):
        z = float(depth[view, 0, v, u])
        x, y = (u + 0.5 - centre_u) * z / CAMERA.focal_length, (v + 0.5 - centre_v) * z / CAMERA.focal_length
        point = to_robot @ np.array([x, y, z, 1.0])
        row, column = EGO.to_cells(point[None, :2])[0]
        for band in range(3):
            inside = 0 <= row < EGO.cells and 0 <= column < EGO.cells
            if inside and HEIGHTS[band] < point[2] <= HEIGHTS[band + 1]:
                expected[view, band, row, column] = 1
    assert expected.any(axis=(0, 2, 3)).all()
    np.testing.assert_array_equal(bands, expected)


def test_the_union_of_bands_is_the_occupied_map() -> None:
    depth = random_depth(1)
    union = HeightBands(CAMERA, EGO, HEIGHTS)(depth)[0].amax(dim=0).numpy()
    occupied = project_depth(depth[0, 0].float().numpy(), CAMERA, EGO, Band(0.2, 1.5)).occupied
    np.testing.assert_array_equal(union, occupied)


def test_no_heights_give_no_band() -> None:
    assert HeightBands(CAMERA, EGO, [])(random_depth(2)).shape == (2, 0, EGO.cells, EGO.cells)


@pytest.mark.parametrize("heights", [[0.5, 0.2], [0.2, 0.2, 0.5]])
def test_heights_that_do_not_ascend_are_refused(heights: list[float]) -> None:
    with pytest.raises(UserError, match="model.heights: got"):
        HeightBands(CAMERA, EGO, heights)


def test_jitter_scales_heights_in_training_only() -> None:
    depth, exact = random_depth(6), HeightBands(CAMERA, EGO, HEIGHTS)
    jittered = HeightBands(CAMERA, EGO, HEIGHTS, jitter=0.2)
    assert torch.equal(jittered.eval()(depth), exact(depth))
    torch.manual_seed(0)
    maps = jittered.train()(depth)
    torch.manual_seed(0)
    factors = 1 + 0.2 * (2 * torch.rand(len(depth), 1, 1) - 1)
    for index, factor in enumerate(factors.flatten().tolist()):
        # scaling heights by a factor is equivalent to dividing the bounds of the bands by it
        scaled = HeightBands(CAMERA, EGO, [height / factor for height in HEIGHTS])(depth)[index]
        assert (
            (maps[index] != scaled).float().mean()
            < 0.001
            < (maps[index] != exact(depth)[index]).float().mean()
        )


def test_jitter_out_of_range_is_refused() -> None:
    with pytest.raises(UserError, match="height_jitter: got 0.9"):
        HeightBands(CAMERA, EGO, HEIGHTS, jitter=0.9)
