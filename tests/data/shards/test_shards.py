"""Datasets of shards: written scene by scene, resumed, and streamed into training."""

import fcntl
import json
import os
import shutil
from dataclasses import dataclass, replace
from errno import ENOSPC
from pathlib import Path
from signal import SIGKILL
from threading import Thread

import numpy as np
import pytest
from hydra.utils import instantiate

from imagination.config.compose import compose
from imagination.data.shards import writer
from imagination.data.shards.reader import ShardCollector, ShardData, Shards
from imagination.data.shards.writer import INDEX, ShardSpec
from imagination.scenes.scene import Scene
from imagination.scenes.sensor import IdealSensor
from imagination.scenes.source import Split
from imagination.utils import errors
from imagination.utils.errors import UserError
from imagination.views.collector import Views, render_views
from imagination.views.pose_samplers import BalancedPoses, UniformPoses
from tests.conftest import Command
from tests.data.test_datamodule import observer, same
from tests.helpers.room_source import Rooms
from tests.helpers.rooms import tiny_room

SPEC = ShardSpec(UniformPoses(), seed=1, views=12, group=2)
SCENES = Rooms(5).scenes("train")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("dataset")
    watcher = observer(tmp_path_factory.mktemp("cache"), Rooms(5))
    for scene in SCENES:
        writer.write_scene(watcher, scene, folder, SPEC)
    writer.write_index(folder, watcher, SPEC)
    return folder


def opened(folder: Path) -> Shards:
    return Shards(str(folder), str(folder / "unused"), 1.0)


def poses(views: Views) -> list[tuple[float, ...]]:
    return [tuple(pose) for pose in views["pose"].tolist()]


def test_what_is_written_is_read(dataset: Path, tmp_path: Path) -> None:
    watcher, read = observer(tmp_path, Rooms(5)), opened(dataset)
    assert read.scenes == dict.fromkeys(sorted(SCENES), 6) and read.group == 2
    read.check(watcher)
    read.check_scenes(watcher, SCENES)
    from zlib import crc32

    seed = (1, writer.Stream.SHARDS, crc32(b"train_3"), 4)
    assert same(read.read("train_3", 4), render_views(watcher, "train_3", UniformPoses(), seed, 2))


def test_every_view_comes_once_a_lap_in_any_order_of_requests(dataset: Path) -> None:
    collector = ShardCollector(opened(dataset), SCENES, seed=3, parallel_scenes=5, steps=4)
    assert collector.views_per_collection == 20
    lap = [collector.start(index)() for index in range(3)]  # 5 scenes x 12 views = 3 collections of 20
    seen = [pose for views in lap for pose in poses(views)]
    assert len(set(seen)) == 60
    again = ShardCollector(opened(dataset), SCENES, seed=3, parallel_scenes=5, steps=4)
    assert all(same(again.start(index)(), lap[index]) for index in (2, 0, 1))
    next_lap = [pose for index in range(3, 6) for pose in poses(collector.start(index)())]
    assert set(next_lap) == set(seen) and next_lap != seen
    other = ShardCollector(opened(dataset), SCENES, seed=4, parallel_scenes=5, steps=4)
    assert not same(other.start(0)(), lap[0])


def test_views_of_another_camera_are_refused(dataset: Path, tmp_path: Path) -> None:
    watcher = observer(tmp_path, Rooms(5))
    other = replace(watcher, camera=replace(watcher.camera, mount_height=1.0))
    with pytest.raises(UserError, match="camera .*1.25.*expected .*1.0"):
        opened(dataset).check(other)
    with pytest.raises(UserError, match=r"update_interval = 5"):
        ShardCollector(opened(dataset), SCENES, 0, 2, steps=5)


def test_damaged_and_missing_files_are_reported(dataset: Path, tmp_path: Path) -> None:
    for path in dataset.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    chunk = tmp_path / "chunk-train_1.bin"
    content = bytearray(chunk.read_bytes())
    content[len(content) // 2] ^= 1
    chunk.write_bytes(bytes(content))
    read = opened(tmp_path)
    with pytest.raises(UserError, match=r"remove chunk-train_1\.bin"):
        [read.read("train_1", number) for number in range(6)]
    read.read("train_2", 0)
    with pytest.raises(UserError, match=f"data.shards: got .*nowhere.*{INDEX}"):
        opened(tmp_path / "nowhere")
    (tmp_path / INDEX).write_text("{}")
    with pytest.raises(UserError, match="cannot be read"):
        opened(tmp_path)
    (tmp_path / INDEX).unlink()
    with pytest.raises(UserError, match="data.shards: got .*index.json"):
        opened(tmp_path)


@pytest.mark.parametrize(
    ("part", "value", "message"),
    [
        ("data_format", ["pickle"], "pickle"),
        ("item_loader", "TokensLoader", "TokensLoader"),
    ],
)
def test_an_index_that_would_run_code_is_refused(
    dataset: Path, tmp_path: Path, part: str, value: object, message: str
) -> None:
    for path in dataset.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    index = json.loads((tmp_path / INDEX).read_text())
    (tmp_path / INDEX).write_text(json.dumps({**index, "config": {**index["config"], part: value}}))
    with pytest.raises(UserError, match=rf"data\.shards: got .*{message}"):
        opened(tmp_path)
    index["chunks"][1]["filename"] = "../chunk-a.bin"
    (tmp_path / INDEX).write_text(json.dumps(index))
    with pytest.raises(UserError, match=r"'\.\./chunk-a\.bin'"):
        opened(tmp_path)


def test_a_missing_extra_names_the_command(monkeypatch: pytest.MonkeyPatch, dataset: Path) -> None:
    monkeypatch.setattr(errors, "find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"litdata: .*'\.\[shards\]'"):
        opened(dataset)


class Attic(Rooms):
    """Rooms, one of which cannot be loaded."""

    def load(self, scene: str) -> Scene:
        if scene == "train_1":
            raise OSError("its roof is missing")
        return super().load(scene)


@dataclass(frozen=True)
class Noisy(IdealSensor):
    """Another sensor."""


def copy(dataset: Path, folder: Path) -> Path:
    return Path(shutil.copytree(dataset, folder / "copy"))


def test_scenes_rendered_with_other_settings_are_refused(dataset: Path, tmp_path: Path) -> None:
    folder, message = copy(dataset, tmp_path), r"sensor .*IdealSensor.*expected .*Noisy"
    watcher = observer(tmp_path, Rooms(2))  # its source has only two of the scenes
    assert writer.unwritten(folder, watcher, SCENES[:2], SPEC) == []
    assert len(writer.write_index(folder, watcher, SPEC)["scenes"]) == 5
    before = (folder / INDEX).read_bytes()
    noisy = replace(watcher, sensor=Noisy())
    with pytest.raises(UserError, match=message):  # before any scene is rendered
        writer.unwritten(folder, noisy, SCENES[:2], SPEC)
    writer.write_scene(noisy, "train_0", folder, SPEC)
    with pytest.raises(UserError, match=message):
        writer.write_index(folder, noisy, SPEC)
    with pytest.raises(UserError, match=r"seed 1, expected 2"):
        writer.write_index(copy(dataset, tmp_path / "seeds"), watcher, replace(SPEC, seed=2))
    assert (folder / INDEX).read_bytes() == before


class Rebuilt(Rooms):
    """Rooms, one of which differs under the same name, e.g. by its furniture."""

    def fingerprint(self, scene: str) -> str:
        return f"{super().fingerprint(scene)} {scene == 'train_1'}"


def test_other_scenes_of_the_same_names_are_refused(dataset: Path, tmp_path: Path) -> None:
    folder, watcher = copy(dataset, tmp_path), observer(tmp_path, Rebuilt(5))
    for scene in SCENES:
        if scene != "train_1":
            writer.write_scene(watcher, scene, folder, SPEC)
    before = (folder / "chunk-train_1.bin").read_bytes()
    with pytest.raises(UserError, match=r"\(train_1\).*train_1\.record\.json"):
        writer.unwritten(folder, watcher, SCENES, SPEC)
    assert (folder / "chunk-train_1.bin").read_bytes() == before
    writer.write_index(folder, watcher, SPEC)
    opened(folder).check_scenes(watcher, ["train_0", "train_2"])
    with pytest.raises(UserError, match="data.shards: .*train_1"):
        opened(folder).check_scenes(watcher, SCENES)
    (folder / "train_1.record.json").unlink()
    assert writer.unwritten(folder, watcher, SCENES, SPEC) == ["train_1"]


def test_poses_drawn_by_another_sampler_are_logged(
    dataset: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    data = streamed(str(dataset), tmp_path, 5)
    data.collector(4)
    assert "poses" not in caplog.text
    data = streamed(str(dataset), tmp_path, 5)
    data.sampler = BalancedPoses(["bed"])
    data.collector(4)
    assert "poses in" in caplog.text and "UniformPoses" in caplog.text and "BalancedPoses" in caplog.text


def test_a_written_scene_is_released_from_memory(tmp_path: Path) -> None:
    watcher = observer(tmp_path, Attic(5))
    dict(writer.write_scenes(watcher, SCENES, tmp_path / "dataset", SPEC, 0))
    assert not watcher._loaded and not watcher._ground_truths


def test_incomplete_files_are_removed_unless_another_job_is_writing(tmp_path: Path) -> None:
    name = writer.chunk_name("train_0")
    part = tmp_path / f".{name}.abcd_123.part"
    part.mkdir()
    (part / name).touch()
    with writer.at_work(tmp_path):
        assert not part.exists()
        part.mkdir()
        with writer.at_work(tmp_path):
            assert part.is_dir()
        assert part.is_dir()
    assert not part.exists()


@pytest.mark.parametrize(
    "content",
    [
        *("", '{"scene": "train_1"}', "[1]", "\x00"),
        '{"scene": "train_1", "fingerprint": "", "made_with": {}, "items": 2, "chunk": {}}',
    ],
)
def test_a_scene_whose_record_is_damaged_is_written_again(
    dataset: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, content: str
) -> None:
    folder, watcher = copy(dataset, tmp_path), observer(tmp_path, Rooms(5))
    (folder / "train_1.record.json").write_text(content)
    (folder / "chunk-train_3.bin").unlink()
    assert writer.unwritten(folder, watcher, SCENES, SPEC) == ["train_1", "train_3"]
    assert "train_1.record.json cannot be read" in caplog.text
    writer.write_index(folder, watcher, SPEC)
    assert list(opened(folder).scenes) == ["train_0", "train_2", "train_4"]


def test_a_dataset_behind_a_url_may_grow(dataset: Path, tmp_path: Path) -> None:
    folder, watcher = copy(dataset, tmp_path), observer(tmp_path, Rooms(6))
    url = f"local://{folder}", str(tmp_path / "kept"), 1.0  # litdata fetches it as it would from s3://
    assert same(Shards(*url).read("train_3", 4), opened(dataset).read("train_3", 4))
    assert list((tmp_path / "kept").rglob("chunk-train_3.bin"))
    writer.write_scene(watcher, "train_5", folder, SPEC)
    writer.write_index(folder, watcher, SPEC)
    extended = Shards(*url)
    assert list(extended.scenes) == [*SCENES, "train_5"]
    assert same(extended.read("train_5", 0), opened(folder).read("train_5", 0))


@pytest.mark.slow
def test_a_dataset_is_read_from_an_s3_server(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The server is that of the package moto[server], if it is installed."""
    server = pytest.importorskip("moto.server").ThreadedMotoServer(port=0)
    server.start()
    try:
        address, port = server.get_host_and_port()
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://{address}:{port}")
        for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
            monkeypatch.setenv(name, "made up")
        monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
        client = pytest.importorskip("boto3").client("s3")
        client.create_bucket(Bucket="bucket")
        for path in dataset.iterdir():
            client.upload_file(str(path), "bucket", f"views/{path.name}")
        fetched = Shards("s3://bucket/views", str(tmp_path / "kept"), 1.0)
        assert fetched.scenes == opened(dataset).scenes
        for scene in SCENES:
            assert same(fetched.read(scene, 3), opened(dataset).read(scene, 3))
        with pytest.raises(UserError, match="data.shards: .*s3://bucket/nothing"):
            Shards("s3://bucket/nothing", str(tmp_path / "none"), 1.0)
    finally:
        server.stop()


@pytest.mark.parametrize("url", ["s3://", "local:///nowhere/at/all"])
def test_a_url_that_cannot_be_fetched_is_refused(
    tmp_path: Path, url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    # otherwise the client requests credentials over the network
    monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")
    with pytest.raises(UserError, match=f"data.shards: .*{url}"):
        Shards(url, str(tmp_path), 1.0)


def streamed(dataset: str, folder: Path, count: int, gigabytes: float = 1.0) -> ShardData:
    """Return a data module that trains on the first `count` rooms from a dataset."""
    return ShardData(
        shards=dataset, shard_cache=str(folder / "kept"), shard_gigabytes=gigabytes,
        observer=observer(folder, Rooms(count)), unit_categories=["bed"], sampler=UniformPoses(),
        eval_sampler=UniformPoses(), imaginable=1.0, neighbourhood=0.62, seed=3, parallel_scenes=2, batch_size=5,
        eval_views={"val": 7, "test": 4}, workers=0,
    )  # fmt: skip


class Named(Rooms):
    """Rooms with names that are paths."""

    NAMES = ("scans/a b", "scans/a_b", "scans_a_b", "about", "-about")

    def scenes(self, split: Split) -> list[str]:
        return list(self.NAMES) if split == "train" else super().scenes(split)

    def load(self, scene: str) -> Scene:
        return tiny_room(turn=0.1 * self.NAMES.index(scene))


def test_scenes_with_any_name_are_written_and_read(tmp_path: Path) -> None:
    watcher = observer(tmp_path, Named())
    spec = replace(SPEC, views=2)
    for scene in Named.NAMES:
        writer.write_scene(watcher, scene, tmp_path / "dataset", spec)
    assert writer.unwritten(tmp_path / "dataset", watcher, Named.NAMES, spec) == []
    writer.write_index(tmp_path / "dataset", watcher, spec)
    read = opened(tmp_path / "dataset")
    assert set(read.scenes) == set(Named.NAMES)
    views = [poses(read.read(scene, 0)) for scene in Named.NAMES]
    assert len({tuple(each) for each in views}) == len(Named.NAMES)


def test_training_uses_only_scenes_of_its_split(
    dataset: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder, tests = copy(dataset, tmp_path), observer(tmp_path, Rooms(5))
    writer.write_scene(tests, "test_0", folder, SPEC)
    writer.write_index(folder, tests, SPEC)
    assert streamed(str(folder), tmp_path, 3).collector(4).scenes == SCENES[:3]
    assert "data.shards: 3 scenes" in caplog.text  # two of train, one of test
    (folder / "train_1.record.json").unlink()
    writer.write_index(folder, tests, SPEC)
    assert streamed(str(folder), tmp_path, 3).collector(4).scenes == ["train_0", "train_2"]
    assert "data.shards: 1 of the 3 training scenes" in caplog.text
    for scene in SCENES:
        (folder / f"{scene}.record.json").unlink(missing_ok=True)
    writer.write_index(folder, tests, SPEC)
    with pytest.raises(UserError, match="data.shards: got test_0 .*expected .*train_0"):
        streamed(str(folder), tmp_path, 3).collector(4)


def test_a_resumed_run_keeps_its_scenes(dataset: Path, tmp_path: Path) -> None:
    folder, watcher = copy(dataset, tmp_path), observer(tmp_path, Rooms(5))
    (folder / "train_2.record.json").rename(tmp_path / "later")
    writer.write_index(folder, watcher, SPEC)
    begun = streamed(str(folder), tmp_path, 5)
    views = begun.collector(4).start(3)()
    (tmp_path / "later").rename(folder / "train_2.record.json")  # the dataset has been extended meanwhile
    writer.write_index(folder, watcher, SPEC)
    resumed = streamed(str(folder), tmp_path, 5)
    resumed.load_state_dict(begun.state_dict())
    assert same(resumed.collector(4).start(3)(), views)
    assert not same(streamed(str(folder), tmp_path, 5).collector(4).start(3)(), views)
    (folder / "train_0.record.json").unlink()
    writer.write_index(folder, watcher, SPEC)
    lost = streamed(str(folder), tmp_path, 5)
    lost.load_state_dict(begun.state_dict())
    with pytest.raises(UserError, match="data.shards: .*train_0"):
        lost.collector(4)


def test_a_resumed_run_keeps_its_dataset_even_if_moved(dataset: Path, tmp_path: Path) -> None:
    begun = streamed(str(dataset), tmp_path, 5)
    views = begun.collector(4).start(3)()
    moved = streamed(str(copy(dataset, tmp_path)), tmp_path, 5)
    moved.load_state_dict(begun.state_dict())
    assert same(moved.collector(4).start(3)(), views)
    watcher, folder = observer(tmp_path, Rooms(5)), tmp_path / "other"
    other = replace(SPEC, seed=2)
    dict(writer.write_scenes(watcher, SCENES, folder, other, 0))
    writer.write_index(folder, watcher, other)
    changed = streamed(str(folder), tmp_path, 5)
    changed.load_state_dict(begun.state_dict())
    with pytest.raises(UserError, match="'seed': 2.* expected .*'seed': 1"):
        changed.collector(4)


def test_the_cache_must_hold_the_parallel_scenes(dataset: Path, tmp_path: Path) -> None:
    largest = max((dataset / f"chunk-{scene}.bin").stat().st_size for scene in SCENES)
    enough = 2 * largest / 1e9  # two parallel scenes
    streamed(f"local://{dataset}", tmp_path, 5, 1.01 * enough).collector(4)
    with pytest.raises(UserError, match="data.module.shard_gigabytes: got .* 2 parallel scenes"):
        streamed(f"local://{dataset}", tmp_path, 5, 0.9 * enough).collector(4)
    streamed(str(dataset), tmp_path, 5, 0.9 * enough).collector(4)  # nothing is fetched from a folder


def test_a_scene_too_large_for_a_chunk_is_refused_before_it_is_rendered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writer, "MAX_BYTES", 50_000)
    (message,) = dict(
        writer.write_scenes(observer(tmp_path, Rooms(5)), SCENES[:1], tmp_path, SPEC, 0)
    ).values()
    assert "views: got 12 per scene, about 0." in message
    assert not list(tmp_path.glob("chunk-*"))


def test_another_version_of_the_program_needs_another_dataset(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writer, "code_version", lambda: "another version")
    with pytest.raises(UserError, match="program .*expected another vers"):
        writer.unwritten(copy(dataset, tmp_path), observer(tmp_path, Rooms(5)), SCENES, SPEC)
    streamed(str(dataset), tmp_path, 5).collector(4)  # training may still read it


def test_a_full_disk_ends_the_dataset(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Further scenes would be rendered in vain."""

    def full(*_: object) -> None:
        raise OSError(ENOSPC, "No space left on device")

    watcher = observer(tmp_path, Rooms(5))
    for scene in SCENES:
        watcher.ground_truth(scene)  # fill the cache, so that only the chunk is written
    monkeypatch.setattr("imagination.utils.atomic_io.os.replace", full)
    written = writer.write_scenes(watcher, SCENES, tmp_path, SPEC, 0)
    with pytest.raises(errors.CannotWriteError, match="No space left on device; free some space"):
        list(written)


def test_an_index_lists_all_scenes_that_exist_when_it_is_written(dataset: Path, tmp_path: Path) -> None:
    folder, watcher = copy(dataset, tmp_path), observer(tmp_path, Rooms(5))
    record = folder / "train_4.record.json"
    content = record.read_text()
    record.unlink()
    before = (folder / INDEX).read_bytes()
    with open(folder / writer.LOCK, "a") as file:
        fcntl.flock(file, fcntl.LOCK_EX)  # like another job that writes the index
        late = Thread(target=writer.write_index, args=(folder, watcher, SPEC))
        late.start()
        late.join(0.5)
        assert late.is_alive() and (folder / INDEX).read_bytes() == before
        record.write_text(content)
    late.join(30)
    assert list(opened(folder).scenes) == SCENES


@dataclass(frozen=True)
class Paths(Rooms):
    """Scenes whose names are paths."""

    def scenes(self, split: Split) -> list[str]:
        return ["scenes/my house.glb", "scenes/my_house.glb"]

    def load(self, scene: str) -> Scene:
        return tiny_room()


def test_a_scene_name_may_be_a_path(tmp_path: Path) -> None:
    watcher, folder = observer(tmp_path / "cache", Paths()), tmp_path / "dataset"
    scenes = Paths().scenes("train")
    assert dict(writer.write_scenes(watcher, scenes, folder, SPEC, 0)) == dict.fromkeys(scenes, "")
    writer.write_index(folder, watcher, SPEC)
    assert sorted(opened(folder).scenes) == scenes
    assert {path.parent for path in tmp_path.rglob("*.record.json")} == {folder}


class Deadly(Rooms):
    """Rooms, one of which kills its process."""

    def load(self, scene: str) -> Scene:
        if scene == "train_1":
            os.kill(os.getpid(), SIGKILL)
        return super().load(scene)


@pytest.mark.slow
def test_a_scene_that_kills_its_worker_is_left_out(tmp_path: Path) -> None:
    watcher, folder = observer(tmp_path / "cache", Deadly(4)), tmp_path / "dataset"
    scenes = Deadly(4).scenes("train")
    problems = dict(writer.write_scenes(watcher, scenes, folder, SPEC, workers=2))
    assert set(problems) == set(scenes) and "was killed" in problems.pop("train_1")
    assert not any(problems.values())
    writer.write_index(folder, watcher, SPEC)
    assert list(opened(folder).scenes) == ["train_0", "train_2", "train_3"]


WRITE = ["scale=test", "data.splits.train=3", "views=8", "shards=dataset"]


@pytest.mark.slow
def test_the_command_writes_and_resumes_and_training_streams(command: Command, tmp_path: Path) -> None:
    done = command("prepare_shards", *WRITE, "part=0", "parts=2")
    assert done.returncode == 0 and "2 scenes, 16 views" in done.stderr, done.stderr
    first = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "dataset").glob("chunk-train*")}
    done = command("prepare_shards", *WRITE)  # all scenes; existing chunks stay
    assert done.returncode == 0 and "3 scenes, 24 views" in done.stderr, done.stderr
    assert "views/s" in done.stderr
    assert all((tmp_path / "dataset" / name).stat().st_mtime_ns == time for name, time in first.items())
    done = command("train", "+experiment=chair_unet", "scale=test", "data=shards", "data.shards=dataset")
    assert done.returncode == 0, done.stderr
    assert list((tmp_path / "outputs" / "chair_unet").glob("*/tables/mapping.csv"))
    done = command(
        "train",
        "+experiment=chair_unet",
        "scale=test",
        "camera.width=40",
        "data=shards",
        "data.shards=dataset",
    )
    assert done.returncode == 2 and "rendered with camera" in done.stderr and "Traceback" not in done.stderr


@pytest.mark.slow
def test_a_broken_scene_is_reported_and_left_out(command: Command, tmp_path: Path) -> None:
    folder = tmp_path / "plugins" / "attic"
    (folder / "conf" / "data" / "scenes").mkdir(parents=True)
    (folder / "attic").mkdir()
    (folder / "attic" / "__init__.py").write_text("")
    (folder / "attic" / "rooms.py").write_text(
        "from tests.data.shards.test_shards import Attic\nclass Rooms(Attic):\n    pass\n"
    )
    (folder / "conf" / "data" / "scenes" / "attic.yaml").write_text("_target_: attic.rooms.Rooms\ncount: 3\n")
    done = command("prepare_shards", "scale=test", "views=4", "shards=dataset", "data/scenes=attic")
    assert done.returncode == 0, done.stderr
    assert "train_1 is left out: OSError: its roof is missing" in done.stderr
    assert "1 scenes failed: train_1" in done.stderr
    scenes = Shards(str(tmp_path / "dataset"), "", 1.0).scenes
    assert list(scenes) == ["train_0", "train_2"]


def test_the_config_builds(dataset: Path) -> None:
    config = compose(
        "train",
        ["+experiment=chair_unet", "scale=test", "data=shards", f"data.shards={dataset}", "paths.run=."],
    )
    module = instantiate(config.data.module)
    with pytest.raises(UserError, match="data.shards: got views"):
        module.collector(4)
    assert json.loads((dataset / INDEX).read_text())["chunks"][0]["filename"] == writer.ABOUT
    assert np.isfinite(module.batch_size)
