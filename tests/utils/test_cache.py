"""The cache: entries are stored and loaded unchanged; damaged entries are rebuilt."""

import errno
import logging
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from imagination.utils.cache import MAGIC, Cache, decode, encode
from imagination.utils.errors import UserError

KEY = {"scene": "train_0001", "spec": {"resolution": 0.02, "layers": ["chair", None]}}
ENTRY = {
    "mask": np.arange(21).reshape(3, 7) % 3 == 0,
    "depth": np.linspace(0, 8, 10, dtype=np.float16),
    "pose": np.array([1.0, np.nan, np.inf]),
    "nothing": np.zeros((0, 4), bool),
    "number": np.array(7, np.int32),
}


NAME = "0a" * 32 + ".bin"
"""File name of an entry."""


def must_not_build() -> dict[str, np.ndarray]:
    raise AssertionError("the entry exists already")


def same(one: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> bool:
    return list(one) == list(other) and all(
        one[name].dtype == other[name].dtype and one[name].shape == other[name].shape
        and np.array_equal(one[name], other[name], equal_nan=one[name].dtype.kind == "f")
        for name in one
    )  # fmt: skip


def test_an_entry_is_built_once(tmp_path: Path) -> None:
    cache = Cache(tmp_path / "deep" / "folder")
    assert cache.load("ground_truth", KEY) is None
    assert same(cache.get_or_build("ground_truth", KEY, lambda: ENTRY), ENTRY)
    again = Cache(str(tmp_path / "deep" / "folder")).get_or_build("ground_truth", KEY, must_not_build)
    assert same(again, ENTRY)
    again["mask"][:] = False  # the arrays are writable
    again["pose"][:] = 0


@given(
    arrays(
        st.sampled_from([bool, np.uint8, np.int64, np.float32]),
        array_shapes(min_dims=0, max_dims=4, min_side=0),
    )
)
def test_encode_and_decode_are_inverse(array: np.ndarray) -> None:
    decoded = decode(encode({"a": array, "b": array.T}))
    assert same(decoded, {"a": array, "b": array.T})


@pytest.mark.parametrize("array", [np.array(["text"]), np.array([None]), np.array([1j])])
def test_types_that_cannot_be_decoded_are_not_stored(tmp_path: Path, array: np.ndarray) -> None:
    with pytest.raises(TypeError, match="cache: got reason of type "):
        Cache(tmp_path).store("models", KEY, {"reason": array})
    assert not list(tmp_path.iterdir())


def test_the_path_depends_on_the_whole_key(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cache = Cache(tmp_path)
    path = cache.path("ground_truth", KEY)
    assert (
        cache.path("ground_truth", dict(reversed(KEY.items()))) == path
    )  # the order of the keys is irrelevant
    others: list[dict[str, Any]] = [
        {**KEY, "scene": "train_0002"},
        {**KEY, "spec": {**KEY["spec"], "resolution": 0.020001}},  # type: ignore[dict-item]
        {**KEY, "spec": {**KEY["spec"], "layers": [None, "chair"]}},  # type: ignore[dict-item]
    ]
    paths = {path, cache.path("views", KEY), *(cache.path("ground_truth", other) for other in others)}
    monkeypatch.setattr("imagination.utils.cache.code_version", lambda: "another")
    assert len(paths | {cache.path("ground_truth", KEY)}) == 6


@pytest.mark.parametrize("damage", ["cut", "empty", "flipped", "foreign", "header"])
def test_damaged_entry_is_reported_and_rebuilt(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, damage: str
) -> None:
    cache = Cache(tmp_path)
    cache.store("ground_truth", KEY, ENTRY)
    path = cache.path("ground_truth", KEY)
    content = bytearray(path.read_bytes())
    if damage == "flipped":
        content[-3] ^= 4
    if damage == "header":
        content[len(MAGIC) + 2] ^= 1
    changed = {"cut": content[:-1], "empty": b"", "foreign": b"PK\x03\x04" * 90}.get(damage, content)
    path.write_bytes(bytes(changed))
    with caplog.at_level(logging.WARNING):
        assert cache.load("ground_truth", KEY) is None
    assert f"{path} is damaged " in caplog.text
    assert same(cache.get_or_build("ground_truth", KEY, lambda: ENTRY), ENTRY)
    assert same(cache.get_or_build("ground_truth", KEY, must_not_build), ENTRY)


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EACCES])
def test_full_disk_leaves_nothing_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    cache = Cache(tmp_path)
    cache.store("ground_truth", {"other": 1}, ENTRY)

    def fail(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(UserError, match=f"{tmp_path}.*{os.strerror(number)}.*paths.cache"):
        cache.get_or_build("ground_truth", KEY, lambda: ENTRY)
    assert list(tmp_path.rglob("*.*")) == [cache.path("ground_truth", {"other": 1})]


def test_folder_that_is_a_file(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match=r"paths\.cache"):
        Cache(tmp_path / "file").get_or_build("ground_truth", KEY, lambda: ENTRY)


def test_failed_build_stores_nothing(tmp_path: Path) -> None:
    with pytest.raises(AssertionError):
        Cache(tmp_path).get_or_build("ground_truth", KEY, must_not_build)
    assert not list(tmp_path.iterdir())


def test_readers_never_see_a_partial_entry(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    cache = Cache(tmp_path)
    entries = [{"a": np.full(50_000, k, np.int64)} for k in range(4)]

    def write(k: int) -> None:
        for _ in range(20):
            cache.store("ground_truth", KEY, entries[k])

    def read(_: int) -> None:
        for _ in range(40):
            if (got := cache.load("ground_truth", KEY)) is not None:
                assert (got["a"] == got["a"][0]).all()

    with ThreadPoolExecutor(6) as pool:
        list(pool.map(lambda job: job[0](job[1]), [(write, k) for k in range(4)] + [(read, 0), (read, 1)]))
    assert not caplog.text and len(list(tmp_path.rglob("*.*"))) == 1


def fill(cache: Cache, *numbers: int) -> None:
    """Store entries of a tenth of a megabyte each."""
    for number in numbers:
        cache.store("views", {"number": number}, {"a": np.full(100_000, number, np.uint8)})


def stored(cache: Cache) -> set[int]:
    return {number for number in range(20) if cache.path("views", {"number": number}).exists()}


def test_least_recently_used_entries_are_removed(tmp_path: Path) -> None:
    cache = Cache(tmp_path, max_gigabytes=0.00045)  # four entries
    fill(cache, 0, 1, 2, 3)
    assert stored(cache) == {0, 1, 2, 3}
    assert cache.load("views", {"number": 0}) is not None  # used again
    fill(cache, 4, 5)
    assert stored(cache) == {0, 3, 4, 5}
    fill(Cache(tmp_path, max_gigabytes=0.00005), 6)  # larger than the limit, but the newest stays
    assert stored(cache) == {6}
    removed = {"number": 0}
    assert same(cache.get_or_build("views", removed, lambda: ENTRY), ENTRY)


def test_threads_that_evict_at_the_same_time_get_their_entries(tmp_path: Path) -> None:
    """Six threads in a cache of four entries: each always gets its entry, and the limit holds at the end."""
    cache = Cache(tmp_path, max_gigabytes=0.00045)

    def use(worker: int) -> None:
        rng = np.random.default_rng(worker)
        for number in rng.integers(0, 12, 60).tolist():
            got = cache.get_or_build(
                "views", {"n": number}, lambda n=number: {"a": np.full(100_000, n, np.uint8)}
            )
            assert (got["a"] == number).all()

    with ThreadPoolExecutor(6) as pool:
        list(pool.map(use, range(6)))
    fill(cache, 0)
    assert sum(path.stat().st_size for path in tmp_path.rglob("*.bin")) <= 450_000
    assert not list(tmp_path.rglob("*.part"))


@pytest.mark.parametrize("limit", [0, -1, float("nan")])
def test_a_limit_out_of_range_is_refused(tmp_path: Path, limit: float) -> None:
    with pytest.raises(UserError, match="cache.max_gigabytes: got"):
        Cache(tmp_path, limit)


def test_only_partial_files_of_killed_processes_are_removed(tmp_path: Path) -> None:
    """One process is killed while it writes, another still writes; both files are old."""
    code = f"""
import os, sys, time
from pathlib import Path
from imagination.utils import atomic_io
atomic_io.os.replace = lambda *_: (print("writing", flush=True), time.sleep(600))
with atomic_io.replacing(Path({str(tmp_path)!r}) / "views" / "{NAME}", sync=False) as temporary:
    temporary.write_bytes(b"half")
"""
    (tmp_path / "views").mkdir()
    writers = [
        subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) for _ in range(2)
    ]
    try:
        for writer in writers:
            assert writer.stdout is not None and writer.stdout.readline() == "writing\n"
        dead, alive = (next(iter(partial_files(tmp_path, writer))) for writer in writers)
        writers[0].kill()
        writers[0].wait()
        fresh = tmp_path / "views" / f".{NAME}.fresh.part"  # new and not locked yet
        fresh.mkdir()
        for path in (dead, alive):
            os.utime(path, (time.time() - 3600,) * 2)
        Cache(tmp_path)
        assert set(tmp_path.rglob(".*.part")) == {alive, fresh}
    finally:
        for writer in writers:
            writer.send_signal(signal.SIGKILL)
            writer.wait()


def snapshot(folder: Path) -> dict[str, object]:
    """Return the content or kind of all that is in a folder."""
    return {
        str(path.relative_to(folder)): path.readlink() if path.is_symlink()
        else path.read_bytes() if path.is_file() else path.stat().st_mode
        for path in sorted(folder.rglob("*"))
    }  # fmt: skip


def make_victim(folder: Path) -> None:
    """Write files of other programs, old and larger than the limit of a cache, with names like those of a cache."""
    views = folder / "views"
    views.mkdir(parents=True)
    (folder / "model.bin").write_bytes(b"weights" * 50_000)
    (views / "pytorch_model.bin").write_bytes(b"weights" * 50_000)
    (views / NAME).write_bytes(b"weights" * 50_000)  # without the magic line
    (views / f"{NAME}.bak").write_bytes(MAGIC * 50_000)
    (views / ("0b" * 32 + ".bin")).mkdir()
    (views / ("0b" * 32 + ".bin") / "kept.txt").write_text("kept")
    os.mkfifo(views / ("0c" * 32 + ".bin"))
    for name in (".download.part", f".{NAME}.abcdefgh.part"):
        (views / name).mkdir()
        (views / name / "kept.txt").write_text("kept")
    for path in folder.rglob("*"):
        os.utime(path, (time.time() - 3600,) * 2)


def test_files_of_others_are_never_removed(tmp_path: Path) -> None:
    victim = tmp_path / "victim"
    make_victim(victim)
    before = snapshot(victim)
    cache = Cache(victim, max_gigabytes=0.00015)
    fill(cache, *range(5))
    assert stored(cache) == {4}
    cache.path("views", {"number": 4}).unlink()
    assert snapshot(victim) == before


def test_nothing_is_removed_through_links(tmp_path: Path) -> None:
    """A subfolder and an entry of the cache, and a temporary folder, are links to entries of another cache."""
    other, linked = Cache(tmp_path / "other"), Cache(tmp_path / "linked", max_gigabytes=0.00015)
    fill(other, *range(5))
    (tmp_path / "other" / "views" / f".{NAME}.abcdefgh.part").mkdir()
    for path in (tmp_path / "other").rglob("*"):
        os.utime(path, (time.time() - 3600,) * 2)
    before = snapshot(tmp_path / "other")
    (tmp_path / "linked" / "views").mkdir(parents=True)
    (tmp_path / "linked" / "more").symlink_to(tmp_path / "other" / "views")
    (tmp_path / "linked" / "views" / NAME).symlink_to(other.path("views", {"number": 0}))
    part = tmp_path / "linked" / "views" / f".{NAME}.abcdefgh.part"
    part.symlink_to(tmp_path / "other" / "views" / part.name)
    fill(Cache(tmp_path / "linked", max_gigabytes=0.00015), *range(10, 15))
    assert snapshot(tmp_path / "other") == before
    assert (
        stored(linked) == {14} and (tmp_path / "linked" / "views" / NAME).is_symlink() and part.is_symlink()
    )


def test_a_fifo_in_place_of_an_entry_is_rebuilt(tmp_path: Path) -> None:
    cache = Cache(tmp_path)
    path = cache.path("views", KEY)
    path.parent.mkdir()
    os.mkfifo(path)
    assert same(cache.get_or_build("views", KEY, lambda: ENTRY), ENTRY)
    assert same(cache.get_or_build("views", KEY, must_not_build), ENTRY)


def partial_files(folder: Path, writer: subprocess.Popen[str]) -> set[Path]:
    """Return the partial files that a process has open."""
    links = [Path(link).resolve() for link in Path(f"/proc/{writer.pid}/fd").iterdir()]
    return set(folder.rglob(".*.part")) & set(links)
