"""The cache: what goes in comes out; what is damaged is made again."""

import errno
import logging
import os
import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from imagination import cache as module
from imagination.cache import Cache
from imagination.errors import UserError

KEY = {"scene": "train_0001", "spec": {"resolution": 0.02, "layers": ["chair", None]}}
ENTRY = {
    "mask": np.arange(21).reshape(3, 7) % 3 == 0,
    "depth": np.linspace(0, 8, 10, dtype=np.float16),
    "pose": np.array([1.0, np.nan, np.inf]),
    "nothing": np.zeros((0, 4), bool),
    "number": np.array(7, np.int32),
}


def must_not_build() -> dict[str, np.ndarray]:
    raise AssertionError("it was there already")


def same(one: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> bool:
    return list(one) == list(other) and all(
        one[name].dtype == other[name].dtype and one[name].shape == other[name].shape
        and np.array_equal(one[name], other[name], equal_nan=one[name].dtype.kind == "f")
        for name in one
    )  # fmt: skip


def test_built_once_and_the_same_ever_after(tmp_path: Path) -> None:
    cache = Cache(tmp_path / "deep" / "folder")
    assert cache.load("truth", KEY) is None
    assert same(cache.get_or_build("truth", KEY, lambda: ENTRY), ENTRY)
    again = Cache(str(tmp_path / "deep" / "folder")).get_or_build("truth", KEY, must_not_build)
    assert same(again, ENTRY)
    again["mask"][:] = False  # callers may change what they got
    again["pose"][:] = 0


@given(
    arrays(
        st.sampled_from([bool, np.uint8, np.int64, np.float32]),
        array_shapes(min_dims=0, max_dims=4, min_side=0),
    )
)
def test_any_array_comes_back(array: np.ndarray) -> None:
    back = module.decode(module.encode({"a": array, "b": array.T}))
    assert same(back, {"a": array, "b": array.T})


def test_key_decides(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cache = Cache(tmp_path)
    path = cache.path("truth", KEY)
    assert cache.path("truth", dict(reversed(KEY.items()))) == path  # order of the keys does not matter
    others: list[dict[str, Any]] = [
        {**KEY, "scene": "train_0002"},
        {**KEY, "spec": {**KEY["spec"], "resolution": 0.020001}},  # type: ignore[dict-item]
        {**KEY, "spec": {**KEY["spec"], "layers": [None, "chair"]}},  # type: ignore[dict-item]
    ]
    paths = {path, cache.path("views", KEY), *(cache.path("truth", other) for other in others)}
    monkeypatch.setattr(module, "code_version", lambda: "another")
    assert len(paths | {cache.path("truth", KEY)}) == 6


@pytest.mark.parametrize("damage", ["cut", "empty", "flipped", "foreign", "header"])
def test_damaged_entry_is_reported_and_made_again(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, damage: str
) -> None:
    cache = Cache(tmp_path)
    cache.store("truth", KEY, ENTRY)
    path = cache.path("truth", KEY)
    content = bytearray(path.read_bytes())
    if damage == "flipped":
        content[-3] ^= 4
    if damage == "header":
        content[len(module.MAGIC) + 2] ^= 1
    changed = {"cut": content[:-1], "empty": b"", "foreign": b"PK\x03\x04" * 90}.get(damage, content)
    path.write_bytes(bytes(changed))
    with caplog.at_level(logging.WARNING):
        assert cache.load("truth", KEY) is None
    assert str(path) in caplog.text and "damaged" in caplog.text
    assert same(cache.get_or_build("truth", KEY, lambda: ENTRY), ENTRY)
    assert same(cache.get_or_build("truth", KEY, must_not_build), ENTRY)


@pytest.mark.parametrize(
    ("number", "advice"), [(errno.ENOSPC, "disk is full"), (errno.EACCES, "Permission denied")]
)
def test_full_disk_leaves_nothing_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, advice: str
) -> None:
    cache = Cache(tmp_path)
    cache.store("truth", {"other": 1}, ENTRY)

    def fail(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(UserError, match=f"{tmp_path}.*{advice}.*set paths.cache"):
        cache.get_or_build("truth", KEY, lambda: ENTRY)
    assert list(tmp_path.rglob("*.*")) == [cache.path("truth", {"other": 1})]


def test_folder_that_is_a_file(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match=r"paths\.cache"):
        Cache(tmp_path / "file").get_or_build("truth", KEY, lambda: ENTRY)


def test_failed_build_stores_nothing(tmp_path: Path) -> None:
    with pytest.raises(AssertionError):
        Cache(tmp_path).get_or_build("truth", KEY, must_not_build)
    assert not list(tmp_path.iterdir())


def test_readers_never_see_a_part(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    cache = Cache(tmp_path)
    entries = [{"a": np.full(50_000, k, np.int64)} for k in range(4)]

    def write(k: int) -> None:
        for _ in range(20):
            cache.store("truth", KEY, entries[k])

    def read(_: int) -> None:
        for _ in range(40):
            if (got := cache.load("truth", KEY)) is not None:
                assert (got["a"] == got["a"][0]).all()

    with ThreadPoolExecutor(6) as pool:
        list(pool.map(lambda job: job[0](job[1]), [(write, k) for k in range(4)] + [(read, 0), (read, 1)]))
    assert not caplog.text and len(list(tmp_path.rglob("*.*"))) == 1


def test_code_version_covers_what_makes_entries(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A change anywhere in the packages named gives another version; they exist and hold code."""
    package = Path(module.__file__).parent
    shutil.copytree(package, tmp_path / "imagination", ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(module, "__file__", str(tmp_path / "imagination" / "cache.py"))
    versions = {module.code_version.__wrapped__()}
    assert versions == {module.code_version()}
    for file in ("geometry/crop.py", "scenes/renderer.py", "ground_truth/maps.py", "views/view.py"):
        with open(tmp_path / "imagination" / file, "a") as code:
            code.write("# changed")
        versions.add(module.code_version.__wrapped__())
    assert len(versions) == 5
