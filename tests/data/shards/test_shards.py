"""Corpora as shards: written scene by scene, gone on with, streamed into the same training."""

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
from imagination.data.shards import writer as corpora
from imagination.data.shards.reader import ShardCollector, ShardData, Shards
from imagination.data.shards.writer import INDEX, ShardSpec
from imagination.scenes.scene import Scene
from imagination.scenes.sensor import IdealSensor
from imagination.scenes.source import Split
from imagination.utils import errors
from imagination.utils.errors import UserError
from imagination.views.collector import Views, look
from imagination.views.pose_samplers import BalancedPoses, UniformPoses
from tests.conftest import Command
from tests.data.test_datamodule import observer, same
from tests.helpers.room_source import Rooms
from tests.helpers.rooms import tiny_room

RECIPE = ShardSpec(UniformPoses(), seed=1, views=12, group=2)
SCENES = Rooms(5).scenes("train")


@pytest.fixture(scope="module")
def corpus(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("corpus")
    watcher = observer(tmp_path_factory.mktemp("cache"), Rooms(5))
    for scene in SCENES:
        corpora.write_scene(watcher, scene, folder, RECIPE)
    corpora.write_index(folder, watcher, RECIPE)
    return folder


def opened(folder: Path) -> Shards:
    return Shards(str(folder), str(folder / "unused"), 1.0)


def poses(views: Views) -> list[tuple[float, ...]]:
    return [tuple(pose) for pose in views["pose"].tolist()]


def test_what_is_written_is_read(corpus: Path, tmp_path: Path) -> None:
    watcher, read = observer(tmp_path, Rooms(5)), opened(corpus)
    assert read.scenes == dict.fromkeys(sorted(SCENES), 6) and read.group == 2
    read.check(watcher)
    read.check_scenes(watcher, SCENES)
    from zlib import crc32

    seed = (1, corpora.Stream.SHARDS, crc32(b"train_3"), 4)
    assert same(read.read("train_3", 4), look(watcher, "train_3", UniformPoses(), seed, 2))


def test_every_view_comes_once_a_lap_whatever_is_asked_first(corpus: Path) -> None:
    collector = ShardCollector(opened(corpus), SCENES, seed=3, parallel_scenes=5, steps=4)
    assert collector.views_per_collection == 20
    lap = [collector.start(index)() for index in range(3)]  # 5 scenes x 12 views = 3 collections of 20
    seen = [pose for views in lap for pose in poses(views)]
    assert len(set(seen)) == 60
    again = ShardCollector(opened(corpus), SCENES, seed=3, parallel_scenes=5, steps=4)
    assert all(same(again.start(index)(), lap[index]) for index in (2, 0, 1))
    next_lap = [pose for index in range(3, 6) for pose in poses(collector.start(index)())]
    assert set(next_lap) == set(seen) and next_lap != seen
    other = ShardCollector(opened(corpus), SCENES, seed=4, parallel_scenes=5, steps=4)
    assert not same(other.start(0)(), lap[0])


def test_views_of_another_camera_are_refused(corpus: Path, tmp_path: Path) -> None:
    watcher = observer(tmp_path, Rooms(5))
    other = replace(watcher, camera=replace(watcher.camera, mount_height=1.0))
    with pytest.raises(UserError, match="were made with camera .*1.25.* but the config asks for .*1.0"):
        opened(corpus).check(other)
    with pytest.raises(UserError, match="write them with that interval"):
        ShardCollector(opened(corpus), SCENES, 0, 2, steps=5)


def test_damage_and_absence_are_told(corpus: Path, tmp_path: Path) -> None:
    for path in corpus.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    chunk = tmp_path / "chunk-train_1.bin"
    content = bytearray(chunk.read_bytes())
    content[len(content) // 2] ^= 1
    chunk.write_bytes(bytes(content))
    read = opened(tmp_path)
    with pytest.raises(UserError, match=r"is damaged, remove chunk-train_1.bin"):
        [read.read("train_1", number) for number in range(6)]
    read.read("train_2", 0)
    with pytest.raises(UserError, match=f"there is no {INDEX}"):
        opened(tmp_path / "nowhere")
    (tmp_path / INDEX).write_text("{}")
    with pytest.raises(UserError, match="cannot be read"):
        opened(tmp_path)
    (tmp_path / INDEX).unlink()
    with pytest.raises(UserError, match="there is no index.json"):
        opened(tmp_path)


@pytest.mark.parametrize(
    ("part", "value", "told"),
    [
        ("data_format", ["pickle"], "expected plain bytes"),
        ("item_loader", "TokensLoader", "expected PyTreeLoader"),
    ],
)
def test_an_index_that_would_run_code_is_refused(
    corpus: Path, tmp_path: Path, part: str, value: object, told: str
) -> None:
    for path in corpus.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    index = json.loads((tmp_path / INDEX).read_text())
    (tmp_path / INDEX).write_text(json.dumps({**index, "config": {**index["config"], part: value}}))
    with pytest.raises(UserError, match=told):
        opened(tmp_path)
    index["chunks"][1]["filename"] = "../chunk-a.bin"
    (tmp_path / INDEX).write_text(json.dumps(index))
    with pytest.raises(UserError, match="names a chunk"):
        opened(tmp_path)


def test_a_missing_extra_names_the_command(monkeypatch: pytest.MonkeyPatch, corpus: Path) -> None:
    monkeypatch.setattr(errors, "find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"litdata: is not installed.*pip install 'imagination\[shards\]'"):
        opened(corpus)


class Attic(Rooms):
    """Rooms of which one is broken."""

    def load(self, scene: str) -> Scene:
        if scene == "train_1":
            raise OSError("its roof is missing")
        return super().load(scene)


@dataclass(frozen=True)
class Noisy(IdealSensor):
    """Another sensor."""


def copy(corpus: Path, folder: Path) -> Path:
    return Path(shutil.copytree(corpus, folder / "copy"))


def test_homes_made_with_other_settings_are_refused(corpus: Path, tmp_path: Path) -> None:
    folder, told = copy(corpus, tmp_path), r"made with sensor .*IdealSensor.* but the config asks for .*Noisy"
    watcher = observer(tmp_path, Rooms(2))  # which knows but two of the scenes
    assert corpora.unwritten(folder, watcher, SCENES[:2], RECIPE) == []
    assert len(corpora.write_index(folder, watcher, RECIPE)["scenes"]) == 5
    before = (folder / INDEX).read_bytes()
    noisy = replace(watcher, sensor=Noisy())
    with pytest.raises(UserError, match=told):  # before any is rendered
        corpora.unwritten(folder, noisy, SCENES[:2], RECIPE)
    corpora.write_scene(noisy, "train_0", folder, RECIPE)
    with pytest.raises(UserError, match=told):
        corpora.write_index(folder, noisy, RECIPE)
    with pytest.raises(UserError, match=r"made with seed 1, but the config asks for 2"):
        corpora.write_index(copy(corpus, tmp_path / "seeds"), watcher, replace(RECIPE, seed=2))
    assert (folder / INDEX).read_bytes() == before


class Rebuilt(Rooms):
    """Rooms of which one is another under the same name, as with other furniture."""

    def fingerprint(self, scene: str) -> str:
        return f"{super().fingerprint(scene)} {scene == 'train_1'}"


def test_other_homes_of_the_same_names_are_refused(corpus: Path, tmp_path: Path) -> None:
    folder, watcher = copy(corpus, tmp_path), observer(tmp_path, Rebuilt(5))
    for scene in SCENES:
        if scene != "train_1":
            corpora.write_scene(watcher, scene, folder, RECIPE)
    before = (folder / "chunk-train_1.bin").read_bytes()
    with pytest.raises(
        UserError, match=r"same names \(train_1\); .* or remove train_1.record.json to write that"
    ):
        corpora.unwritten(folder, watcher, SCENES, RECIPE)
    assert (folder / "chunk-train_1.bin").read_bytes() == before
    corpora.write_index(folder, watcher, RECIPE)
    opened(folder).check_scenes(watcher, ["train_0", "train_2"])
    with pytest.raises(UserError, match="other scenes than the config's of these names: train_1; choose"):
        opened(folder).check_scenes(watcher, SCENES)
    (folder / "train_1.record.json").unlink()
    assert corpora.unwritten(folder, watcher, SCENES, RECIPE) == ["train_1"]


def test_training_is_told_of_poses_drawn_otherwise(
    corpus: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    data = streamed(str(corpus), tmp_path, 5)
    data.collector(4)
    assert "poses" not in caplog.text
    data = streamed(str(corpus), tmp_path, 5)
    data.sampler = BalancedPoses(["bed"])
    data.collector(4)
    assert "poses in" in caplog.text and "UniformPoses, but the config asks for" in caplog.text


def test_a_written_home_is_held_no_longer(tmp_path: Path) -> None:
    watcher = observer(tmp_path, Attic(5))
    dict(corpora.write_scenes(watcher, SCENES, tmp_path / "corpus", RECIPE, 0))
    assert not watcher._loaded and not watcher._truths


def test_what_is_half_written_goes_unless_another_job_is_at_work(tmp_path: Path) -> None:
    part = tmp_path / f".{corpora.chunk_name('train_0')}.x.part"
    part.mkdir()
    (part / "chunk").touch()
    with corpora.at_work(tmp_path):
        assert not part.exists()
        part.mkdir()
        with corpora.at_work(tmp_path):
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
def test_a_home_whose_record_is_damaged_is_written_again(
    corpus: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, content: str
) -> None:
    folder, watcher = copy(corpus, tmp_path), observer(tmp_path, Rooms(5))
    (folder / "train_1.record.json").write_text(content)
    (folder / "chunk-train_3.bin").unlink()
    assert corpora.unwritten(folder, watcher, SCENES, RECIPE) == ["train_1", "train_3"]
    assert "train_1.record.json cannot be read" in caplog.text
    corpora.write_index(folder, watcher, RECIPE)
    assert list(opened(folder).scenes) == ["train_0", "train_2", "train_4"]


def test_a_corpus_behind_a_url_may_grow(corpus: Path, tmp_path: Path) -> None:
    folder, watcher = copy(corpus, tmp_path), observer(tmp_path, Rooms(6))
    url = f"local://{folder}", str(tmp_path / "kept"), 1.0  # litdata fetches it as it would from s3://
    assert same(Shards(*url).read("train_3", 4), opened(corpus).read("train_3", 4))
    assert list((tmp_path / "kept").rglob("chunk-train_3.bin"))
    corpora.write_scene(watcher, "train_5", folder, RECIPE)
    corpora.write_index(folder, watcher, RECIPE)
    grown = Shards(*url)
    assert list(grown.scenes) == [*SCENES, "train_5"]
    assert same(grown.read("train_5", 0), opened(folder).read("train_5", 0))


@pytest.mark.slow
def test_a_corpus_is_read_from_an_s3_server(
    corpus: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the package moto[server], where it is installed."""
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
        for path in corpus.iterdir():
            client.upload_file(str(path), "bucket", f"views/{path.name}")
        fetched = Shards("s3://bucket/views", str(tmp_path / "kept"), 1.0)
        assert fetched.scenes == opened(corpus).scenes
        for scene in SCENES:
            assert same(fetched.read(scene, 3), opened(corpus).read(scene, 3))
        with pytest.raises(UserError, match="s3://bucket/nothing cannot be fetched"):
            Shards("s3://bucket/nothing", str(tmp_path / "none"), 1.0)
    finally:
        server.stop()


@pytest.mark.parametrize("url", ["s3://", "local:///nowhere/at/all"])
def test_a_url_that_cannot_be_fetched_is_told(
    tmp_path: Path, url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")  # else it asks for credentials over the network
    with pytest.raises(UserError, match="cannot be fetched .*; check the address and the credentials"):
        Shards(url, str(tmp_path), 1.0)


def streamed(corpus: str, folder: Path, count: int, gigabytes: float = 1.0) -> ShardData:
    """Data of a training on the first `count` rooms, out of a corpus."""
    return ShardData(
        shards=corpus, shard_cache=str(folder / "kept"), shard_gigabytes=gigabytes,
        observer=observer(folder, Rooms(count)), unit_categories=["bed"], sampler=UniformPoses(),
        eval_sampler=UniformPoses(), imaginable=1.0, neighbourhood=0.62, seed=3, parallel_scenes=2, batch_size=5,
        eval_views={"val": 7, "test": 4}, workers=0,
    )  # fmt: skip


def test_training_takes_the_homes_of_its_split_alone(
    corpus: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder, tests = copy(corpus, tmp_path), observer(tmp_path, Rooms(5))
    corpora.write_scene(tests, "test_0", folder, RECIPE)
    corpora.write_index(folder, tests, RECIPE)
    assert streamed(str(folder), tmp_path, 3).collector(4).scenes == SCENES[:3]
    assert "3 scenes in it are not of this training" in caplog.text  # two of train, one of test
    (folder / "train_1.record.json").unlink()
    corpora.write_index(folder, tests, RECIPE)
    assert streamed(str(folder), tmp_path, 3).collector(4).scenes == ["train_0", "train_2"]
    assert "1 of the 3 scenes of training are not in it" in caplog.text
    for scene in SCENES:
        (folder / f"{scene}.record.json").unlink(missing_ok=True)
    corpora.write_index(folder, tests, RECIPE)
    with pytest.raises(UserError, match="holds test_0, expected scenes of the training split: train_0"):
        streamed(str(folder), tmp_path, 3).collector(4)


def test_a_run_goes_on_with_the_homes_it_began_with(corpus: Path, tmp_path: Path) -> None:
    folder, watcher = copy(corpus, tmp_path), observer(tmp_path, Rooms(5))
    (folder / "train_2.record.json").rename(tmp_path / "later")
    corpora.write_index(folder, watcher, RECIPE)
    begun = streamed(str(folder), tmp_path, 5)
    views = begun.collector(4).start(3)()
    (tmp_path / "later").rename(folder / "train_2.record.json")  # the corpus has grown meanwhile
    corpora.write_index(folder, watcher, RECIPE)
    resumed = streamed(str(folder), tmp_path, 5)
    resumed.load_state_dict(begun.state_dict())
    assert same(resumed.collector(4).start(3)(), views)
    assert not same(streamed(str(folder), tmp_path, 5).collector(4).start(3)(), views)
    (folder / "train_0.record.json").unlink()
    corpora.write_index(folder, watcher, RECIPE)
    lost = streamed(str(folder), tmp_path, 5)
    lost.load_state_dict(begun.state_dict())
    with pytest.raises(UserError, match="does not hold train_0 any more, which this run began with"):
        lost.collector(4)


def test_a_run_goes_on_with_the_corpus_it_began_with_wherever_it_lies(corpus: Path, tmp_path: Path) -> None:
    begun = streamed(str(corpus), tmp_path, 5)
    views = begun.collector(4).start(3)()
    moved = streamed(str(copy(corpus, tmp_path)), tmp_path, 5)
    moved.load_state_dict(begun.state_dict())
    assert same(moved.collector(4).start(3)(), views)
    watcher, folder = observer(tmp_path, Rooms(5)), tmp_path / "other"
    other = replace(RECIPE, seed=2)
    dict(corpora.write_scenes(watcher, SCENES, folder, other, 0))
    corpora.write_index(folder, watcher, other)
    changed = streamed(str(folder), tmp_path, 5)
    changed.load_state_dict(begun.state_dict())
    with pytest.raises(UserError, match="'seed': 2.* expected .*'seed': 1.* go on with that corpus"):
        changed.collector(4)


def test_homes_that_are_open_at_once_have_room(corpus: Path, tmp_path: Path) -> None:
    largest = max((corpus / f"chunk-{scene}.bin").stat().st_size for scene in SCENES)
    enough = 2 * largest / 1e9  # two scenes are looked into at once
    streamed(f"local://{corpus}", tmp_path, 5, 1.01 * enough).collector(4)
    with pytest.raises(
        UserError, match="data.module.shard_gigabytes: got .*, expected at least .* of the 2 scenes"
    ):
        streamed(f"local://{corpus}", tmp_path, 5, 0.9 * enough).collector(4)
    streamed(str(corpus), tmp_path, 5, 0.9 * enough).collector(4)  # nothing is fetched from a folder


def test_a_home_that_no_chunk_can_hold_is_told_before_it_is_rendered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(corpora, "MAX_BYTES", 50_000)
    (told,) = dict(
        corpora.write_scenes(observer(tmp_path, Rooms(5)), SCENES[:1], tmp_path, RECIPE, 0)
    ).values()
    assert "views: got 12 of each scene, about 0." in told and "write fewer of more scenes" in told
    assert not list(tmp_path.glob("chunk-*"))


def test_another_version_of_the_program_writes_another_corpus(
    corpus: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(corpora, "code_version", lambda: "another version")
    with pytest.raises(UserError, match="made with program .* but the config asks for another vers"):
        corpora.unwritten(copy(corpus, tmp_path), observer(tmp_path, Rooms(5)), SCENES, RECIPE)
    streamed(str(corpus), tmp_path, 5).collector(4)  # trainings may read it all the same


def test_a_full_disk_ends_the_corpus(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The scenes after it would be rendered in vain."""

    def full(*_: object) -> None:
        raise OSError(ENOSPC, "No space left on device")

    watcher = observer(tmp_path, Rooms(5))
    for scene in SCENES:
        watcher.truth(scene)  # what lies in the cache is there already
    monkeypatch.setattr("imagination.runs.folder.os.replace", full)
    written = corpora.write_scenes(watcher, SCENES, tmp_path, RECIPE, 0)
    with pytest.raises(errors.CannotWriteError, match="No space left on device; free some space"):
        list(written)


def test_an_index_lists_all_that_was_there_when_it_is_written(corpus: Path, tmp_path: Path) -> None:
    folder, watcher = copy(corpus, tmp_path), observer(tmp_path, Rooms(5))
    record = folder / "train_4.record.json"
    content = record.read_text()
    record.unlink()
    before = (folder / INDEX).read_bytes()
    with open(folder / corpora.LOCK, "a") as file:
        fcntl.flock(file, fcntl.LOCK_EX)  # as another job that writes the index
        late = Thread(target=corpora.write_index, args=(folder, watcher, RECIPE))
        late.start()
        late.join(0.5)
        assert late.is_alive() and (folder / INDEX).read_bytes() == before
        record.write_text(content)
    late.join(30)
    assert list(opened(folder).scenes) == SCENES


@dataclass(frozen=True)
class Paths(Rooms):
    """A scene whose name is a path."""

    def scenes(self, split: Split) -> list[str]:
        return ["scenes/my house.glb", "scenes/my_house.glb"]

    def load(self, scene: str) -> Scene:
        return tiny_room()


def test_a_home_may_be_named_by_a_path(tmp_path: Path) -> None:
    watcher, folder = observer(tmp_path / "cache", Paths()), tmp_path / "corpus"
    scenes = Paths().scenes("train")
    assert dict(corpora.write_scenes(watcher, scenes, folder, RECIPE, 0)) == dict.fromkeys(scenes, "")
    corpora.write_index(folder, watcher, RECIPE)
    assert sorted(opened(folder).scenes) == scenes
    assert {path.parent for path in tmp_path.rglob("*.record.json")} == {folder}


class Deadly(Rooms):
    """Rooms of which one takes its process with it."""

    def load(self, scene: str) -> Scene:
        if scene == "train_1":
            os.kill(os.getpid(), SIGKILL)
        return super().load(scene)


def test_a_home_that_kills_its_worker_is_left_out(tmp_path: Path) -> None:
    watcher, folder = observer(tmp_path / "cache", Deadly(4)), tmp_path / "corpus"
    scenes = Deadly(4).scenes("train")
    problems = dict(corpora.write_scenes(watcher, scenes, folder, RECIPE, workers=2))
    assert set(problems) == set(scenes) and "was killed" in problems.pop("train_1")
    assert not any(problems.values())
    corpora.write_index(folder, watcher, RECIPE)
    assert list(opened(folder).scenes) == ["train_0", "train_2", "train_3"]


WRITE = ["scale=test", "scale.scenes.train=3", "views=8", "shards=corpus"]


def test_the_command_writes_goes_on_and_training_streams(command: Command, tmp_path: Path) -> None:
    done = command("prepare_shards", *WRITE, "part=0", "parts=2")
    assert done.returncode == 0 and "2 scenes, 16 views" in done.stderr, done.stderr
    first = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "corpus").glob("chunk-train*")}
    done = command("prepare_shards", *WRITE)  # all of them: those that are there stay
    assert done.returncode == 0 and "3 scenes, 24 views" in done.stderr, done.stderr
    assert "a million take" in done.stderr
    assert all((tmp_path / "corpus" / name).stat().st_mtime_ns == time for name, time in first.items())
    done = command("train", "+experiment=chair_unet", "scale=test", "data=shards", "data.shards=corpus")
    assert done.returncode == 0, done.stderr
    assert list((tmp_path / "outputs" / "chair_unet").glob("*/tables/mapping.csv"))
    done = command(
        "train", "+experiment=chair_unet", "scale=test", "scale.image=40", "data=shards", "data.shards=corpus"
    )
    assert done.returncode == 2 and "were made with camera" in done.stderr and "Traceback" not in done.stderr


def test_a_broken_home_is_told_and_left_out(command: Command, tmp_path: Path) -> None:
    folder = tmp_path / "plugins" / "attic"
    (folder / "conf" / "data" / "scenes").mkdir(parents=True)
    (folder / "attic").mkdir()
    (folder / "attic" / "__init__.py").write_text("")
    (folder / "attic" / "rooms.py").write_text(
        "from tests.data.shards.test_shards import Attic\nclass Rooms(Attic):\n    pass\n"
    )
    (folder / "conf" / "data" / "scenes" / "attic.yaml").write_text("_target_: attic.rooms.Rooms\ncount: 3\n")
    done = command("prepare_shards", "scale=test", "views=4", "shards=corpus", "data/scenes=attic")
    assert done.returncode == 0, done.stderr
    assert "train_1 is left out: OSError: its roof is missing" in done.stderr
    assert "1 scenes failed: train_1; run this again" in done.stderr
    scenes = Shards(str(tmp_path / "corpus"), "", 1.0).scenes
    assert list(scenes) == ["train_0", "train_2"]


def test_the_config_builds(corpus: Path) -> None:
    config = compose(
        "train",
        ["+experiment=chair_unet", "scale=test", "data=shards", f"data.shards={corpus}", "paths.run=."],
    )
    module = instantiate(config.data.module)
    with pytest.raises(UserError, match="were made with"):
        module.collector(4)
    assert json.loads((corpus / INDEX).read_text())["chunks"][0]["filename"] == corpora.ABOUT
    assert np.isfinite(module.batch_size)
