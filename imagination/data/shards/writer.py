"""A corpus of views as litdata shards, written scene by scene.

An item is a group of views of one scene, encoded as in the cache; a scene's items make one chunk. Item 0 describes the
corpus: what its views depend on, and how many items each scene has. Scenes are written whole or not at all, each with a
record beside its chunk, so that any number of jobs may write to one folder and go on where another stopped.
"""

from __future__ import annotations

import fcntl
import json
import logging
import os
import re
import time
from collections.abc import Generator, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import IO, Any, NamedTuple
from zlib import crc32

from imagination.utils.atomic_io import remove_parts, replacing, write_text
from imagination.utils.cache import as_plain, code_version, encode
from imagination.utils.errors import (
    CannotWriteError,
    UserError,
    WorkerDiedError,
    check_range,
    first_of,
    require_extra,
)
from imagination.views.collector import PoseSampler, look
from imagination.views.observer import Observer
from imagination.views.random_streams import Stream
from imagination.views.scene_workers import ScenePool

log = logging.getLogger(__name__)

INDEX = "index.json"
"""Where litdata looks for the list of chunks."""

ABOUT = "chunk-about.bin"
"""The chunk with the description alone."""

MAX_BYTES = 2**32 - 2**20
"""In a chunk: litdata's offsets in it are of 32 bits."""

LOCK, WORK = ".index.lock", ".work.lock"
"""Held by the job that writes the index, and shared by all that write scenes."""


@dataclass(frozen=True)
class ShardSpec:
    """What is written of each scene.

    Attributes:
        sampler: draws poses.
        seed: of poses and sensor noise.
        views: of each scene.
        group: views in an item.
    """

    sampler: PoseSampler
    seed: int
    views: int
    group: int

    def __post_init__(self) -> None:
        check_range("views", self.views, 1, 10_000_000, "views of each scene")
        if self.views % self.group:
            raise UserError(
                f"views: got {self.views} of each scene, expected a multiple of scale.update_interval = {self.group}"
            )

    def made_with(self, observer: Observer) -> dict[str, Any]:
        """What the views of all scenes of a corpus have in common."""
        program = {"program": code_version()[:12]}  # which renders and projects
        return as_read({**describe(observer), **as_plain(self), **program})


class Record(NamedTuple):
    """What is known of a written scene.

    Attributes:
        scene: its name.
        fingerprint: of the scene.
        made_with: what else its views depend on, in common with those of the other scenes.
        items: groups of views.
        chunk: what litdata's index says of it.
    """

    scene: str
    fingerprint: str
    made_with: dict[str, Any]
    items: int
    chunk: dict[str, Any]


def read_records(folder: Path, observer: Observer, recipe: ShardSpec) -> dict[str, Record]:
    """Records of the scenes that are written, by scene; one that cannot be read is told and counts as none.

    Raises:
        UserError: if a scene was made with other settings: one description holds for the whole corpus.
    """
    asked, records = recipe.made_with(observer), {}
    for path in sorted(folder.glob("*.record.json")):
        try:
            record = _checked(Record(**json.loads(path.read_text())))
            written = (folder / chunk_name(record.scene)).is_file()
        except (OSError, ValueError, TypeError, RecursionError) as error:
            log.warning("shards: %s cannot be read (%s); its scene counts as not written", path, error)
            continue
        if different := difference(record.made_with, asked):
            raise UserError(
                f"shards: the views of {record.scene} in {folder} were made with {different}; write to another "
                "folder, or remove this one"
            )
        if written:
            records[record.scene] = record
    return records


def _checked(record: Record) -> Record:
    """The same, if its parts are what they should be."""
    kinds = zip(record, (str, str, dict, int, dict), strict=True)
    if not all(isinstance(part, kind) for part, kind in kinds) or "entry" not in record.chunk:
        raise ValueError("its parts are not those of a record")
    return record


def unwritten(folder: Path, observer: Observer, scenes: Sequence[str], recipe: ShardSpec) -> list[str]:
    """Those of the scenes that are not there yet.

    Raises:
        UserError: if the folder holds scenes that were made with other settings, or other scenes of these names.
    """
    records = read_records(folder, observer, recipe)
    written = [scene for scene in scenes if scene in records]
    if others := [
        scene for scene in written if records[scene].fingerprint != observer.source.fingerprint(scene)
    ]:
        raise UserError(
            f"shards: got other scenes than {folder} holds under the same names ({first_of(others)}); write to another "
            f"folder, take the scene source as it was, or remove {_record(folder, others[0]).name} to write that anew"
        )
    return [scene for scene in scenes if scene not in records]


@contextmanager
def at_work(folder: Path) -> Iterator[None]:
    """Say that a job writes to a folder; the first that comes and the last that goes remove what is half-written."""
    with open(folder / WORK, "a") as file:
        _tidy(folder, file)
        fcntl.flock(file, fcntl.LOCK_SH)
        try:
            yield
        finally:
            _tidy(folder, file)


def _tidy(folder: Path, lock: IO[str]) -> None:
    with suppress(BlockingIOError):  # others are at work
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        remove_parts(folder)


def write_scenes(
    observer: Observer, scenes: Sequence[str], folder: Path, recipe: ShardSpec, workers: int
) -> Generator[tuple[str, str], None, None]:
    """Write scenes, one at a time in each worker; gives each with what went wrong, or an empty string.

    A scene whose worker is killed, as when it takes too much memory, has failed; a new worker goes on with the others.

    Raises:
        UserError: if the number of workers is out of range, or nothing can be written.
    """
    check_range("scale.workers", workers, 0, 1024)
    waiting = list(reversed(scenes))
    idle = [ScenePool(observer, min(workers, 1)) for _ in range(max(workers, 1))]
    running: dict[Future[str], tuple[str, ScenePool]] = {}
    try:
        while waiting or running:
            while waiting and idle:
                scene, pool = waiting.pop(), idle.pop()
                running[pool.submit(try_scene, scene, folder, recipe)] = scene, pool
            for task in wait(running, return_when=FIRST_COMPLETED).done:
                scene, pool = running.pop(task)
                try:
                    problem = task.result()
                except WorkerDiedError:
                    pool.close()
                    pool = ScenePool(observer, 1)
                    problem = "its process was killed, as for want of memory; try it with scale.workers=1"
                except CannotWriteError:
                    pool.close()
                    raise
                idle.append(pool)
                yield scene, problem
    finally:
        for pool in [*idle, *(pool for _, pool in running.values())]:
            pool.close()


def write_scene(observer: Observer, scene: str, folder: Path, recipe: ShardSpec) -> None:
    """Render a scene's views and write its chunk, then its record; runs in a worker process."""
    seed = (recipe.seed, Stream.SHARDS, crc32(scene.encode()))
    items, groups, written = [], recipe.views // recipe.group, 0
    try:
        for group in range(groups):
            items.append(encode(look(observer, scene, recipe.sampler, (*seed, group), recipe.group)))
            written += len(items[-1])
            size = written * groups / len(items)
            if size > MAX_BYTES:  # told after the first group, not after the last
                raise UserError(
                    f"views: got {recipe.views} of each scene, about {size / 1e9:.1f} GB, expected at most "
                    f"{MAX_BYTES / 1e9:.1f} GB, as much as a chunk can hold; write fewer of more scenes"
                )
    finally:
        observer.forget(scene)  # else a worker would hold every scene of the corpus in the end
    chunk = _write_chunk(folder / chunk_name(scene), items)
    fingerprint = observer.source.fingerprint(scene)
    record = Record(scene, fingerprint, recipe.made_with(observer), len(items), chunk)
    write_text(_record(folder, scene), json.dumps(record._asdict()))


def try_scene(observer: Observer, scene: str, folder: Path, recipe: ShardSpec) -> str:
    """Write a scene; what went wrong, or an empty string.

    Raises:
        UserError: if nothing can be written: the scenes after it would be rendered in vain.
    """
    try:
        write_scene(observer, scene, folder, recipe)
    except CannotWriteError:
        raise
    except Exception as error:  # of any scene source: the other scenes do not wait for it
        return f"{type(error).__name__}: {error}"
    return ""


def write_index(folder: Path, observer: Observer, recipe: ShardSpec) -> dict[str, Any]:
    """List everything written so far, for readers; returns the description.

    Raises:
        UserError: if nothing was written, or the folder holds scenes that were made with other settings.
    """
    with open(folder / LOCK, "a") as file:
        fcntl.flock(file, fcntl.LOCK_EX)  # else a job that listed fewer scenes might write its list last
        records = read_records(folder, observer, recipe)
        if not records:
            raise UserError(f"shards: no scene was written to {folder}; see the messages above")
        scenes = {
            scene: {"items": each.items, "fingerprint": each.fingerprint} for scene, each in records.items()
        }
        about = {"views": describe(observer), "recipe": as_plain(recipe), "scenes": scenes}
        first = _write_chunk(folder / ABOUT, [json.dumps(about).encode()])
        chunks = [first["entry"], *(record.chunk["entry"] for record in records.values())]
        # by this time alone litdata knows that what it keeps of a URL is out of date
        index = {"chunks": chunks, "config": first["config"], "updated_at": str(time.time())}
        write_text(folder / INDEX, json.dumps(index))
    return about


def describe(observer: Observer) -> dict[str, Any]:
    """What the views of any scene depend on, apart from the scene."""
    parts = ("camera", "sensor", "ego", "obstacles", "ground_truth_spec")
    table = {row.name: as_plain(row.aliases) for row in observer.categories}
    return {**{part: as_plain(getattr(observer, part)) for part in parts}, "categories": table}


def as_read(description: dict[str, Any]) -> dict[str, Any]:
    """The same after it went through a file."""
    read: dict[str, Any] = json.loads(json.dumps(description))
    return read


def difference(made_with: Mapping[str, Any], asked: Mapping[str, Any]) -> str:
    """The first part of a description in which views are not what is asked for; an empty string if there is none."""
    for part, value in asked.items():
        if made_with.get(part) != value:
            return f"{part} {made_with.get(part)}, but the config asks for {value}"
    return ""


def prepare_litdata() -> None:
    """See that litdata can be imported, and quietly.

    Raises:
        UserError: if it is not installed.
    """
    require_extra("litdata", "shards")
    # else it asks PyPI, for 30 s where there is no network
    os.environ.setdefault("LITDATA_DISABLE_VERSION_CHECK", "1")


def _stem(scene: str) -> str:
    """Name of a scene's files: the scene's own, unless it is a path or has characters that an index may not hold."""
    allowed = re.sub(r"[^\w.+-]", "_", scene)
    return scene if allowed == scene else f"{allowed}-{crc32(scene.encode()):08x}"


def chunk_name(scene: str) -> str:
    """Of a scene's chunk."""
    return f"chunk-{_stem(scene)}.bin"


def _record(folder: Path, scene: str) -> Path:
    return folder / f"{_stem(scene)}.record.json"


def _write_chunk(path: Path, items: Sequence[bytes]) -> dict[str, Any]:
    """Write items as one chunk; what litdata's index says of it."""
    prepare_litdata()
    from litdata.streaming.writer import BinaryWriter

    with replacing(path) as temporary, TemporaryDirectory(dir=temporary.parent) as scratch:
        writer = BinaryWriter(scratch, chunk_size=len(items) + 1)
        for number, item in enumerate(items):
            writer[number] = item
        writer.done()
        writer.merge(1)
        index = json.loads((Path(scratch) / INDEX).read_text())
        (entry,) = index["chunks"]
        os.replace(Path(scratch) / entry["filename"], temporary)
    return {"entry": {**entry, "filename": path.name}, "config": index["config"]}
