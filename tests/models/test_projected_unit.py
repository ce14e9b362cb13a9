"""Image features projected into the egocentric grid, compared with a loop and with the depth projection."""

import numpy as np
import pytest
import torch

from imagination.geometry.camera import Camera
from imagination.geometry.grid import EgoGrid
from imagination.geometry.projection import Band, project_depth
from imagination.models.projected_unit import Projection
from imagination.utils.errors import UserError

CAMERA = Camera.from_degrees(24, 16, 80.0, 1.2, pitch=15.0, roll=4.0)
EGO = EgoGrid.of_extent(4.0, 0.2)


def random_depth(views: int, seed: int = 0) -> torch.Tensor:
    generator = np.random.default_rng(seed)
    depth = generator.uniform(0.3, 6.0, (views, 1, CAMERA.height, CAMERA.width))
    depth[generator.random(depth.shape) < 0.2] = 0
    return torch.from_numpy(depth).half()


def means_by_loop(image: np.ndarray, depth: np.ndarray, max_height: float) -> np.ndarray:
    """Compute the means pixel by pixel with the methods of the camera and the grid."""
    cells: dict[tuple[int, int], list[np.ndarray]] = {}
    (centre_u, centre_v), to_robot = CAMERA.principal_point, CAMERA.to_robot()
    for v in range(CAMERA.height):
        for u in range(CAMERA.width):
            z = float(depth[v, u])
            x, y = (
                (u + 0.5 - centre_u) * z / CAMERA.focal_length,
                (v + 0.5 - centre_v) * z / CAMERA.focal_length,
            )
            point = to_robot @ np.array([x, y, z, 1.0])
            row, column = EGO.to_cells(point[None, :2])[0].tolist()
            if z > 0 and point[2] <= max_height and 0 <= row < EGO.cells and 0 <= column < EGO.cells:
                cells.setdefault((row, column), []).append(np.append(image[:, v, u], point[2]))
    means = np.zeros((len(image) + 1, EGO.cells, EGO.cells))
    for (row, column), values in cells.items():
        means[:, row, column] = np.mean(values, axis=0)
    return means


@pytest.mark.parametrize("max_height", [0.9, 1.5, 10.0])
def test_means_equal_those_of_a_loop(max_height: float) -> None:
    image, depth = torch.rand(3, 5, CAMERA.height, CAMERA.width), random_depth(3)
    means = Projection(CAMERA, EGO, max_height)(image, depth).numpy()
    for view in range(3):
        expected = means_by_loop(image[view].numpy(), depth[view, 0].numpy(), max_height)
        np.testing.assert_allclose(means[view], expected, atol=1e-4)


def test_gradients_reach_exactly_the_pixels_with_a_return_in_the_grid() -> None:
    image, depth = torch.rand(1, 2, CAMERA.height, CAMERA.width, requires_grad=True), random_depth(1)
    projection = Projection(CAMERA, EGO, 1.5)
    projection(image, depth)[:, :2].sum().backward()
    weights = projection(torch.ones(1, 2, CAMERA.height, CAMERA.width), depth)[:, 0].sum()
    assert image.grad is not None
    torch.testing.assert_close(image.grad[:, 0].sum(), weights)  # each cell's mean spreads a gradient of 1
    assert not image.grad[:, :, depth[0, 0] == 0].any()


def test_the_left_of_the_image_is_projected_to_the_left_of_the_grid() -> None:
    camera, ego = Camera.from_degrees(64, 64, 90.0, 1.25), EgoGrid.of_extent(5.2, 0.1)
    depth = np.zeros((64, 64), np.float32)
    depth[36:44, 4:12] = 2.0  # a box's face, 2 m ahead, below the optical axis and far to the left
    image = torch.from_numpy(depth > 0)[None, None].float()
    marked = Projection(camera, ego, 1.5)(image, torch.from_numpy(depth).half()[None, None])[0, 0].numpy() > 0
    rows, columns = np.nonzero(marked)
    assert len(rows) and (columns < ego.cells // 2).all()
    assert (np.abs(rows - (ego.cells - 1 - 20)) <= 1).all()
    view = project_depth(depth, camera, ego, Band(0.2, 1.5))
    np.testing.assert_array_equal(marked, view.occupied)


def test_images_of_another_size_are_refused() -> None:
    with pytest.raises(UserError, match=r"\(8, 8\).*\(16, 24\)"):
        Projection(CAMERA, EGO, 1.5)(torch.zeros(1, 2, 8, 8), torch.zeros(1, 1, 8, 8).half())
