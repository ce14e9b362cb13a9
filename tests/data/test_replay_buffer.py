"""Replay buffer compared with a plain list of views."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imagination.data.replay_buffer import ReplayBuffer
from imagination.utils.errors import UserError


def numbered(first: int, count: int) -> dict[str, np.ndarray]:
    """Views that carry their number in every array."""
    number = np.arange(first, first + count)
    bits = (number[:, None] >> np.arange(15)) & 1
    return {
        "rgb": (number[:, None, None, None] % 256 * np.ones((1, 2, 2, 3))).astype(np.uint8),
        "depth": number[:, None, None].astype(np.float16) * np.ones((1, 2, 2), np.float16),
        "seen": bits.reshape(count, 3, 5).astype(bool),
        "pose": np.stack([number, number, number], axis=1).astype(np.float64),
    }


def numbers(views: dict[str, np.ndarray]) -> list[int]:
    got = views["pose"][:, 0].astype(int)
    bits = (views["seen"].reshape(len(got), 15) * (1 << np.arange(15))).sum(axis=1)
    assert (bits == got).all()  # the packed mask belongs to the same view as the pose
    assert (views["rgb"][:, 0, 0, 0] == got % 256).all()
    return got.tolist()


@settings(max_examples=50, deadline=None)
@given(
    size=st.integers(6, 40),
    collections=st.integers(1, 12),
    factor=st.sampled_from([0.0, 0.5, 0.9, 1.0]),
    seed=st.integers(0, 99),
)
def test_a_batch_mixes_the_past_with_the_newest_collection(
    size: int, collections: int, factor: float, seed: int
) -> None:
    buffer, kept = ReplayBuffer(size, factor), []
    for index in range(collections):
        buffer.insert(numbered(6 * index, 6))
        kept = (kept + list(range(6 * index, 6 * index + 6)))[-size:]
    assert len(buffer) == len(kept)
    past, newest = set(kept[:-6]), set(kept[-6:])
    batch = 5
    old = round(factor * batch) if past else 0
    if old > len(past):
        with pytest.raises(UserError, match="batch_size: got 5"):
            buffer.draw(batch, np.random.default_rng(seed))
        return
    drawn = numbers(buffer.draw(batch, np.random.default_rng(seed)))
    assert len(set(drawn)) == batch
    assert len(past & set(drawn)) == old
    assert len(newest & set(drawn)) == batch - old


def test_a_draw_does_not_depend_on_overwritten_views() -> None:
    whole, resumed = ReplayBuffer(20, 0.9), ReplayBuffer(20, 0.9)
    for index in range(9):
        whole.insert(numbered(6 * index, 6))
    for index in range(5, 9):  # what a resumed run inserts: enough collections to fill the buffer
        resumed.insert(numbered(6 * index, 6))
    for seed in range(5):
        draws = [numbers(buffer.draw(8, np.random.default_rng(seed))) for buffer in (whole, resumed)]
        assert draws[0] == draws[1]


def test_every_kept_view_is_drawn_sooner_or_later() -> None:
    buffer = ReplayBuffer(18, 0.5)
    for index in range(4):
        buffer.insert(numbered(6 * index, 6))
    drawn = {number for seed in range(60) for number in numbers(buffer.draw(6, np.random.default_rng(seed)))}
    assert drawn == set(range(6, 24))


@pytest.mark.parametrize("factor", [-0.1, 1.1, float("nan")])
def test_the_aggregation_factor_is_checked(factor: float) -> None:
    with pytest.raises(UserError, match="aggregation_factor: got"):
        ReplayBuffer(10, factor)


def test_a_collection_larger_than_the_buffer_is_refused() -> None:
    with pytest.raises(UserError, match=r"buffer size: got 5"):
        ReplayBuffer(5, 0.9).insert(numbered(0, 6))


def test_once_nothing_more_is_collected_all_views_are_equally_likely() -> None:
    buffer = ReplayBuffer(100, 0.5)
    for number in range(10):
        buffer.insert({"pose": np.full((10, 3), number, np.float64)})
    buffer.settle()
    rng = np.random.default_rng(0)
    drawn = np.concatenate([buffer.draw(40, rng)["pose"][:, 0] for _ in range(50)])
    fractions = np.bincount(drawn.astype(int), minlength=10) / len(drawn)
    assert fractions == pytest.approx(0.1, abs=0.025)  # before, half of each batch came from the newest ten
