"""Pairing of streamed messages, and intrinsics of CameraInfo."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imagination.geometry.rgbd import Intrinsics
from imagination.recordings.ros_messages import Pairing, intrinsics_of, is_rectified
from imagination.recordings.trajectory import SECOND
from imagination.utils.errors import UserError
from tests.helpers.robot import ROS1, ROS2, Messages

TICK = SECOND // 60
"""Interval of images of one kind, nanoseconds; smaller than the tolerance of pairs."""


def paired(messages: list[tuple[str, int]], **settings: Any) -> tuple[list[tuple[int, int]], int]:
    """Time stamps (colour, depth) of all pairs, and the number of unpaired messages."""
    pairing: Pairing[int] = Pairing(0.02, **settings)
    found = [pair for kind, stamp in messages for pair in pairing.add(kind, stamp, stamp)]
    found += pairing.flush()
    assert all(stamp == colour for stamp, colour, _ in found)
    return [(colour, depth) for _, colour, depth in found], pairing.unpaired


@pytest.mark.parametrize("lost", ["colour", "depth"])
def test_a_lost_image_does_not_shift_the_others(lost: str) -> None:
    messages = [(kind, n * TICK) for n in range(8) for kind in ("colour", "depth") if (kind, n) != (lost, 2)]
    assert paired(messages) == ([(n * TICK, n * TICK) for n in range(8) if n != 2], 1)


def test_equal_times_do_not_wait() -> None:
    pairing: Pairing[str] = Pairing(0.02)
    assert pairing.add("depth", 5, "d") == [] and pairing.add("colour", 5, "c") == [(5, "c", "d")]


@given(
    late=st.floats(-0.4, 0.4),
    lost=st.sets(st.tuples(st.sampled_from(["colour", "depth"]), st.integers(0, 19)), max_size=12),
    waits=st.integers(0, 3),
)
def test_cameras_that_are_not_in_step(late: float, lost: set[tuple[str, int]], waits: int) -> None:
    """With any lost images and any delay of one kind, images pair with their partner or not at all."""
    times = {
        "colour": [n * TICK for n in range(20) if ("colour", n) not in lost],
        "depth": [round((n + late) * TICK) for n in range(20) if ("depth", n) not in lost],
    }
    messages = [
        (stamp + waits * TICK * (kind == "depth"), kind, stamp) for kind in times for stamp in times[kind]
    ]
    found, alone = paired([(kind, stamp) for _, kind, stamp in sorted(messages)])
    both = [n for n in range(20) if not {("colour", n), ("depth", n)} & lost]
    assert set((n * TICK, round((n + late) * TICK)) for n in both) <= set(found)
    assert alone == len(times["colour"]) + len(times["depth"]) - 2 * len(found)
    assert len({colour for colour, _ in found}) == len({depth for _, depth in found}) == len(found)


@pytest.mark.parametrize("stray", ["colour", "depth"])
@pytest.mark.parametrize("first", ["colour", "depth"])
def test_one_time_far_ahead_costs_its_image_alone(stray: str, first: str) -> None:
    kinds = (first, "depth" if first == "colour" else "colour")
    messages = [(kind, n * TICK) for n in range(20) for kind in kinds]
    assert paired([*messages[:10], (stray, 3600 * SECOND), *messages[10:]]) == (
        [(n * TICK, n * TICK) for n in range(20)],
        1,
    )


def test_images_that_are_far_apart_pair_as_others_do() -> None:
    messages = [(kind, 5 * n * SECOND) for n in range(6) for kind in ("colour", "depth")]
    assert paired(messages) == ([(5 * n * SECOND, 5 * n * SECOND) for n in range(6)], 0)
    late = [(kind, stamp + (kind == "depth") * SECOND // 100) for kind, stamp in messages]
    assert len(paired(late)[0]) == 6


def test_waiting_messages_are_dropped_beyond_the_limit() -> None:
    assert paired([("depth", n * TICK) for n in range(100)], max_waiting=5) == ([], 100)


@pytest.mark.parametrize("store", [ROS1, ROS2])
def test_rectified_images_have_another_matrix_and_no_distortion(store: Any) -> None:
    """sensor_msgs/CameraInfo: P is that of the rectified image; K and D are those of the raw one."""
    messages = Messages(store, store is ROS1)
    raw = Intrinsics(640, 480, 500.0, 501.0, 320.0, 240.0, (0.1, -0.2, 0.0, 0.0, 0.0))
    info = messages.info(0, "camera", raw)
    p = np.array([450.0, 0, 310, -20, 0, 451, 235, 0, 0, 0, 1, 0])
    setattr(info, "P" if store is ROS1 else "p", p)
    assert intrinsics_of(info) == raw
    assert intrinsics_of(info, rectified=True) == Intrinsics(640, 480, 450.0, 451.0, 310.0, 235.0)
    info.distortion_model = "equidistant"
    with pytest.raises(UserError, match="rectified=true"):
        intrinsics_of(info)
    assert intrinsics_of(info, rectified=True).fx == 450
    info.distortion_model = "plumb_bob"
    p[:] = 0  # as drivers that were never calibrated leave it
    assert intrinsics_of(info, rectified=True) == raw


def test_rectified_images_are_detected_by_the_topic_name() -> None:
    assert is_rectified("/camera/depth/image_rect_raw", None) and is_rectified(
        "/c/image_rect/compressed", None
    )
    assert not is_rectified("/direct/image_raw", None) and is_rectified("/direct/image_raw", True)
    assert not is_rectified("/c/image_rect", False)
