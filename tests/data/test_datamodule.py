"""Collecting views: the result depends neither on the workers nor on the cache."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from imagination.data.datamodule import SceneData
from imagination.data.replay_buffer import ReplaySettings
from imagination.geometry.camera import Camera
from imagination.geometry.grid import EgoGrid
from imagination.geometry.projection import Band
from imagination.ground_truth.scene_maps import GroundTruthSpec
from imagination.scenes.categories import Category, CategoryTable
from imagination.scenes.sensor import IdealSensor
from imagination.utils.cache import Cache
from imagination.utils.errors import UserError
from imagination.views.collector import Views
from imagination.views.observer import Observer
from imagination.views.pose_samplers import BalancedPoses, UniformPoses
from tests.helpers.room_source import Rooms
from tests.helpers.rooms import tiny_room

OBSTACLES = Band(0.2, 1.5)
REPLAY = ReplaySettings(
    size=40,
    update_interval=2,
    update_batches=3,
    aggregation_factor=0.5,
    prefill_steps=2,
    collection_epochs=9,
)
TABLE = CategoryTable([Category(name, (255, 0, 0), {"rooms": [name]}) for name in ("chair", "bed", "table")])


def observer(folder: Path, source: Rooms = Rooms()) -> Observer:  # noqa: B008  (immutable)
    camera = Camera.from_degrees(32, 32, 90, 1.25)
    spec = GroundTruthSpec(12.0, 0.12, 1.0, 0.6, OBSTACLES, Camera.from_degrees(48, 48, 90, 1.25))
    ego = EgoGrid.of_extent(5.22, 0.12)
    return Observer(source, camera, IdealSensor(), ego, OBSTACLES, spec, TABLE, Cache(folder))


def data(folder: Path, workers: int = 0, seed: int = 1, source: Rooms = Rooms(), **others: Any) -> SceneData:  # noqa: B008
    eval_views = {"val": 7, "test": 4}
    settings = 1.0, 0.62, seed, 4, 3, eval_views, workers
    return SceneData(observer(folder, source), ["bed"], UniformPoses(), UniformPoses(), *settings, **others)  # type: ignore[arg-type]


def same(one: Views, other: Views) -> bool:
    return one.keys() == other.keys() and all(np.array_equal(one[name], other[name]) for name in one)


def test_workers_order_and_cache_change_nothing(tmp_path: Path) -> None:
    alone, pooled = data(tmp_path / "a"), data(tmp_path / "b", workers=2)
    try:
        in_order = [alone.collector(2).start(index)() for index in (0, 1, 2)]
        shuffled = {index: pooled.collector(2).start(index) for index in (2, 0, 1)}
        for index, views in enumerate(in_order):
            assert same(views, shuffled[index]())
            assert same(views, data(tmp_path / "a").collector(2).start(index)())  # from the cache
        assert not same(in_order[0], in_order[1])
        assert not same(in_order[0], data(tmp_path / "a", seed=2).collector(2).start(0)())
    finally:
        pooled.close()


def test_each_scene_comes_once_before_any_comes_again(tmp_path: Path) -> None:
    collector = data(tmp_path).collector(1)
    laps = [[collector._scene_of(3 * lap + place) for place in range(3)] for lap in range(6)]
    assert all(sorted(lap) == sorted(Rooms().scenes("train")) for lap in laps)
    assert len({tuple(lap) for lap in laps}) > 1


def test_evaluation_views_do_not_depend_on_the_runs_seed(tmp_path: Path) -> None:
    batches = [list(data(tmp_path / str(seed), seed=seed).val_dataloader()) for seed in (1, 2)]
    assert [len(batch["rgb"]) for batch in batches[0]] == [4, 3]
    for one, other in zip(*batches, strict=True):
        assert all((one[name] == other[name]).all() for name in one)


def test_a_batch_holds_what_a_unit_needs(tmp_path: Path) -> None:
    batch = next(iter(data(tmp_path).val_dataloader()))
    shapes = {name: tuple(value.shape) for name, value in batch.items()}
    maps = {name: (4, 1, 43, 43) for name in ("occupied", "seen", "label", "neighbourhood")}
    assert shapes == {"rgb": (4, 3, 32, 32), "depth": (4, 1, 32, 32), **maps}
    whole = [batch for batch in data(tmp_path).val_dataloader()]
    assert sum(int(batch["label"].sum()) for batch in whole) > 0


def test_layers_follow_the_category_table(tmp_path: Path) -> None:
    views = data(tmp_path).collector(2).start(0)()
    assert not np.array_equal(views["object"][:, 0], views["object"][:, 1])
    everywhere = {**views, "seen": np.ones_like(views["seen"])}
    # the label of a completely seen object is the object itself
    label = data(tmp_path).assemble(everywhere)["label"]
    assert np.array_equal(label[:, 0].numpy().astype(bool), views["object"][:, TABLE.index("bed") - 1])


def test_an_unknown_category_names_those_that_exist(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="got 'sofa'.*bed, chair, table"):
        SceneData(observer(tmp_path), ["sofa"], UniformPoses(), UniformPoses(), 1.0, 0.62, 1, 4, 5, {}, 0)


def test_a_category_without_objects_in_a_split_is_refused(tmp_path: Path) -> None:
    made = data(tmp_path)
    lamps = CategoryTable([*TABLE.rows, Category("piano", (0, 0, 0), {"rooms": ["piano"]})])
    asks = Observer(
        **{
            **{
                name: getattr(made.observer, name)
                for name in ("source", "camera", "sensor", "ego", "obstacles", "ground_truth_spec", "cache")
            },
            "categories": lamps,
        }
    )
    settings = 1.0, 0.62, 1, 4, 5, {}, 0
    module = SceneData(asks, ["piano"], UniformPoses(), UniformPoses(), *settings, replay=REPLAY)
    with pytest.raises(UserError, match="category 'piano'.*3 scenes.*'train'"):
        module.setup("fit")


@pytest.mark.parametrize("begin", [lambda module: module.setup("fit"), SceneData.train_dataloader])
def test_training_without_a_replay_buffer_is_refused(
    tmp_path: Path, begin: Callable[[SceneData], object]
) -> None:
    with pytest.raises(UserError, match="callbacks.replay_buffer: got none"):
        begin(data(tmp_path))


def test_balanced_poses_look_at_the_object() -> None:
    room = tiny_room()
    bed = np.array(room.of_category("bed")[0].box.centre[:2])
    poses = BalancedPoses(["bed"], fraction=1.0, distance=9.0, spread=0.1)(room, 20, np.random.default_rng(0))
    for pose in poses:
        ahead = pose.to_robot(bed[None])[0]
        assert ahead[0] > 0 and abs(np.arctan2(ahead[1], ahead[0])) <= 0.1 + 1e-9
