"""Images of views: content of the panels."""

import numpy as np

from imagination.callbacks.unit_images import PANEL, SEEN, draw


def test_each_view_has_a_row_of_panels() -> None:
    views = {
        "rgb": np.full((2, 3, 8, 8), 200, np.uint8),
        "depth": np.full((2, 1, 8, 8), 3.0, np.float16),
        "occupied": np.zeros((2, 1, 9, 9), np.uint8),
        "seen": np.ones((2, 1, 9, 9), np.uint8),
        "label": np.ones((2, 1, 9, 9), np.uint8),
    }
    prediction = np.zeros((2, 1, 9, 9), np.float32)
    prediction[:, :, 4, 4] = 1.0
    prediction[:, :, 0, 0] = 0.4  # below the threshold and far from valid cells
    image = draw(views, prediction, valid_threshold=0.5, epsilon=3)
    assert image.shape == (2 * PANEL, 6 * PANEL, 3)
    middle = [image[PANEL // 2, PANEL * column + PANEL // 2] for column in range(6)]
    expected = [200, 127, SEEN[0], 255, 255, 255]
    assert [int(colour[0]) for colour in middle] == expected
    corner = [int(image[8, PANEL * column + 8, 0]) for column in (4, 5)]
    assert corner == [102, 0]
