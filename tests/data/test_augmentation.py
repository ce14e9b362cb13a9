import numpy as np

from imagination.data.augmentation import mirrored
from imagination.geometry.camera import Camera
from imagination.geometry.grid import EgoGrid
from imagination.geometry.projection import Band, project_depth


def test_maps_of_a_mirrored_image_are_the_mirrored_maps() -> None:
    camera, ego = Camera.from_degrees(32, 24, 90.0, 1.25), EgoGrid.of_extent(3.0, 0.12)
    depth = np.random.default_rng(0).uniform(0.5, 4.0, (3, 24, 32)).astype(np.float32)

    def project(images: np.ndarray) -> list[np.ndarray]:
        maps = [project_depth(image, camera, ego, Band(0.2, 1.5)) for image in images]
        return [np.stack([each.occupied for each in maps]), np.stack([each.seen for each in maps])]

    occupied, seen = project(depth)
    rgb = np.random.default_rng(1).integers(0, 256, (3, 24, 32, 3), dtype=np.uint8)
    views = {"pose": np.zeros((3, 3)), "rgb": rgb, "depth": depth, "occupied": occupied, "seen": seen}
    selected = np.array([True, False, True])
    flipped = mirrored(views, selected)
    projected_occupied, projected_seen = project(flipped["depth"])
    assert np.array_equal(flipped["occupied"], projected_occupied) and occupied.mean() > 0.01
    # floor between two returns is seen along a line of cells, which rounds to one side
    assert (flipped["seen"] != projected_seen).mean() < 0.01 < seen.mean()
    assert np.array_equal(flipped["rgb"][0, :, 0], rgb[0, :, -1])
    assert "pose" not in flipped
    for name, values in flipped.items():
        assert np.array_equal(values[1], views[name][1])
        assert not np.array_equal(values[0], views[name][0])
    assert np.array_equal(mirrored(flipped, selected)["depth"], depth)
