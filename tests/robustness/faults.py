"""What may happen to training, mapping and rendering, and what must come of them nevertheless."""

import json
import os
import random
import resource
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from tensorboard.backend.event_processing.event_file_loader import EventFileLoader

from imagination.data.shards.writer import ABOUT, INDEX
from imagination.deployment.export import export
from imagination.runs.checkpoint import Checkpoint, read_state
from imagination.runs.folder import BEST, COMPOSED, CONFIG, LAST
from imagination.utils.atomic_io import PART
from tests.conftest import ROOT
from tests.helpers.checkpoints import make_checkpoint, samples
from tests.helpers.robot import corridor_path, drive, record_tum
from tests.helpers.rooms import tiny_room
from tests.helpers.toy_units import CAMERA

Result = dict[str, bytes]
"""What a run leaves, by name."""

Done = dict[str, int]
"""What work is finished, and when, in nanoseconds."""

FRAMES = 200
"""Of the recorded drive."""

SCENES = 3
"""Of the corpus."""

TICK = 0.005
"""Seconds between two looks at a process."""

HANGS = 300.0
"""Seconds after which a process will not end any more."""

PART = f"*{PART}"
"""Names of what is half-written, in run folders as in the cache."""


@dataclass(frozen=True)
class Job:
    """A command whose result is the same to the bit, whatever happens meanwhile.

    Attributes:
        name: of the command.
        words: what it is asked to do.
        result: where its result lies, under the folder it runs in; beside it those of other runs.
        read: what of a result is there, by readers that refuse what is half-written.
        cached: whether it reads and fills the cache.
        done: what of its work need not be done again, if it is stopped now.
        again: what of that was done again by the command that went on.
    """

    name: str
    words: tuple[str, ...]
    result: str
    read: Callable[[Path], Result]
    cached: bool
    done: Callable[[Path], Done] = lambda path: {}
    again: Callable[[Path, Done], list[str]] = lambda path, done: []


def trained(run: Path) -> Done:
    """Steps of training in the last checkpoint."""
    if not (run / LAST).is_file():
        return {}
    return {str(read_state(run / LAST)["global_step"]): time.time_ns()}


def trained_again(run: Path, done: Done) -> list[str]:
    """Steps that were logged since, though a checkpoint held them before."""
    return [
        str(event.step)
        for steps, when in done.items()
        for file in (run / "tensorboard").rglob("events.*")
        if file.stat().st_mtime_ns > when
        for event in EventFileLoader(str(file)).Load()
        if event.step < int(steps) and any(value.tag.startswith("train/") for value in event.summary.value)
    ]


def written(corpus: Path) -> Done:
    """When the scenes that are there were written."""
    return {path.name: path.stat().st_mtime_ns for path in corpus.glob("*.record.json")}


def written_again(corpus: Path, done: Done) -> list[str]:
    """Scenes that were there and are newer now."""
    now = written(corpus)
    return [name for name, time in done.items() if now.get(name) != time]


def read_training(run: Path) -> Result:
    """Tables and weights; nothing before the run has ended."""
    states = {path: read_state(run / path) for path in (LAST, BEST) if (run / path).is_file()}
    tables = [run / "tables" / name for name in ("mapping.csv", "ego.csv")]
    if not all(table.is_file() for table in tables):
        return {}
    weights = {name: value.numpy().tobytes() for name, value in states[LAST]["state_dict"].items()}
    return weights | {table.name: table.read_bytes() for table in tables}


def read_map(run: Path) -> Result:
    """All files but those with dates or paths."""
    files = [path for path in run.iterdir() if path.is_file()]
    return {path.name: path.read_bytes() for path in files if path.name not in ("run.log", CONFIG)}


def read_corpus(corpus: Path) -> Result:
    """Chunks and records; index and description, which name all scenes, once these are there, without the date."""
    found = {path.name: path.read_bytes() for kind in ("bin", "json") for path in corpus.glob(f"*.{kind}")}
    index = json.loads(found.pop(INDEX, "{}")) | {"updated_at": ""}
    if len(index.get("chunks", [])) == SCENES + 1:
        return found | {INDEX: json.dumps(index).encode()}
    return {name: content for name, content in found.items() if name != ABOUT}


def jobs(folder: Path) -> list[Job]:
    """What is to be done again and again; a recorded drive and a unit to map it with are made in the folder."""
    scene = tiny_room()
    record_tum(folder / "tum", list(drive(scene, CAMERA, corridor_path(scene.free_space, FRAMES))), CAMERA)
    unit = folder / "chair.onnx"
    export([Checkpoint.read(make_checkpoint(folder / "chair.ckpt"))], unit, "onnx", "float32", samples(1))
    camera = "recording.camera.values.colour={width:48,height:48,fx:24,fy:24,cx:23.5,cy:23.5}"
    train = "+experiment=chair_unet", "scale=test", "scale.epochs=4", "scale.eval_every=2", "scale.workers=1"
    render = "scale=test", f"scale.scenes.train={SCENES}", "scale.workers=1", "views=16"
    corpus = "outputs/render/corpus"
    drive_words = "recording=tum", f"recording.path={folder / 'tum'}", f"unit={unit}", camera
    return [
        Job("train", train, "outputs/chair_unet/latest", read_training, True, trained, trained_again),
        Job("map", drive_words, "outputs/map/latest", read_map, cached=False),
        Job(
            "prepare_shards", (*render, f"shards={corpus}"), corpus, read_corpus, True, written, written_again
        ),
    ]


class Ended(NamedTuple):
    """How a process ended: its exit code and what it told."""

    code: int
    told: str


Watch = Callable[[int], None]
"""Called every few milliseconds with the id of a process that runs."""


class Undisturbed(NamedTuple):
    """A run to which nothing happened.

    Attributes:
        folder: it ran in, with its cache.
        result: what is to come of every run.
        seconds: it took.
        largest, used: bytes of its largest file and of the disk.
    """

    folder: Path
    result: Result
    seconds: float
    largest: int
    used: int


class Faults:
    """Each method does one thing to a job in a folder of its own and checks what comes of it.

    Args:
        folder: for undisturbed runs.
        seed: of the moments at which things break.

    Attributes:
        count: how often what was done to which job.
        peaks: memory of each job's processes since it was emptied last, MB.
    """

    def __init__(self, folder: Path, seed: int) -> None:
        self.folder, self.random = folder, random.Random(seed)
        self.count: Counter[tuple[str, str]] = Counter()
        self.peaks: dict[str, float] = {}
        self.undisturbed: dict[str, Undisturbed] = {}

    def nothing(self, job: Job) -> None:
        """The job runs through: what is to come of it whatever happens."""
        folder, begin = self.folder / job.name, time.monotonic()
        ended = self._wait(job, self._start(job, folder))
        seconds, result = time.monotonic() - begin, job.read(folder / job.result)
        assert ended.code == 0 and result, ended
        files = [path.stat() for path in folder.rglob("*") if path.is_file()]
        largest, used = max(file.st_size for file in files), sum(512 * file.st_blocks for file in files)
        self.undisturbed[job.name] = Undisturbed(folder, result, seconds, largest, used)

    def killed(self, job: Job, folder: Path) -> None:
        """SIGKILL at a random moment, while a file is half-written, once work is finished; each time it goes on."""
        seconds, result = self.undisturbed[job.name].seconds, folder / job.result

        def later() -> bool:
            return time.monotonic() > moment

        def halfway() -> bool:
            return bool(set(folder.rglob(PART)) - before)

        def finished() -> Done:
            return job.done(result) if result.is_dir() else {}

        def further() -> bool:
            return bool(set(finished()) - set(done))

        order = [further, later, lambda: later() and halfway()]
        for ready in order[:: -1 if self.count["killed", job.name] % 2 else 1]:
            moment = time.monotonic() + self.random.uniform(0, seconds)
            before, done = set(folder.rglob(PART)), finished()
            ended = self._wait(job, self._start(job, folder), killer(ready))
            assert ended.code in (0, -signal.SIGKILL), ended.told
            self.count["kills", job.name] += ended.code != 0
            self.count["halfway", job.name] += halfway()
            self._not_again(job, result, done)
            self._sound(job, folder)
        done = finished()
        self._finish(job, folder)
        self._not_again(job, result, done)

    def limited(self, job: Job, folder: Path) -> None:
        """No file may grow beyond a limit: one message says so; without it the job goes on with what is there."""
        self._refused(job, folder, self._less(self.undisturbed[job.name].largest, 0.01))
        self._finish(job, folder)

    def full_disk(self, job: Job, folder: Path) -> None:
        """The disk is too small: one message says so; with more room the job goes on with what is there."""
        size = self._less(
            self.undisturbed[job.name].used, 0.1
        )  # with less, even run.log fails, with a traceback
        with disk(folder, size):
            self._refused(job, folder)
            subprocess.run(["mount", "-o", "remount,size=1g", folder], check=True)
            self._finish(job, folder)

    def damaged(self, job: Job, folder: Path) -> None:
        """Once the job has begun to read the cache, all entries that it has not read yet are damaged."""
        began, done, cache = time.time(), False, self.undisturbed[job.name].folder / "cache"

        def damage(process: int) -> None:
            nonlocal done
            entries = [] if done else sorted(cache.rglob("*.bin"))
            unread = [path for path in entries if path.stat().st_mtime < began]  # reading sets the time
            if len(unread) < len(entries):
                done = True
                for path in unread:
                    self._damage(path)

        ended = self._finish(job, folder, cache=cache, watch=damage)
        self.count["found", job.name] += ended.told.count("is damaged")

    def shared(self, job: Job, folder: Path) -> None:
        """Two at once fill one empty cache; two that render, one corpus as well."""
        both = [self._start(job, folder) for _ in range(2)]
        for process in both:
            ended = self._wait(job, process)
            assert ended.code == 0, ended.told
        for found in self._sound(job, folder):
            self._whole(job, found)

    def _damage(self, path: Path) -> None:
        """Cut a file, or flip one of its bits."""
        content = bytearray(path.read_bytes() or b"0")
        place = self.random.randrange(len(content))
        content[place] ^= 1 << self.random.randrange(8)
        path.write_bytes(content[:place] if self.random.random() < 0.5 else content)

    def _not_again(self, job: Job, result: Path, done: Done) -> None:
        """A command that went on did nothing of what was done before."""
        if done:
            again = job.again(result, done)
            assert not again, f"{job.name} did again what was done: {again} of {done}"
            self.count["kept", job.name] += 1

    def _less(self, size: int, least: float) -> int:
        """A random size that is too small, of any magnitude down to a share of it."""
        return int(size * least ** self.random.uniform(0.1, 1))

    def _refused(self, job: Job, folder: Path, limit: int | None = None) -> None:
        """The job cannot write, tells it in one message and leaves nothing that is not sound."""
        ended = self._wait(job, self._start(job, folder, limit=limit))
        errors = [line for line in ended.told.splitlines() if line.startswith("error: ")]
        assert (ended.code, len(errors)) == (2, 1), ended
        assert not list(folder.rglob(PART)), "something half-written stayed"
        assert "Traceback" not in ended.told, ended
        assert "could not write" in ended.told or "cannot write" in ended.told, ended
        self._sound(job, folder)

    def _start(
        self, job: Job, folder: Path, *, limit: int | None = None, cache: Path | None = None
    ) -> "subprocess.Popen[bytes]":
        """Start a job in its folder, or let it go on; its cache is there as well unless another is given."""
        folder.mkdir(exist_ok=True)
        begun = (folder / job.result / COMPOSED).is_file()  # which only training can go on with
        words = ["resume=latest"] if begun else [*job.words]
        words += [f"paths.cache={cache or folder / 'cache'}"]
        process = subprocess.Popen(
            [sys.executable, "-m", f"imagination.{job.name}", *words],
            env=os.environ | {"PYTHONPATH": str(ROOT), "PYTHONDONTWRITEBYTECODE": "1"},
            cwd=folder,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            start_new_session=True,
        )
        if limit is not None:
            resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (limit, limit))
        return process

    def _wait(
        self, job: Job, process: "subprocess.Popen[bytes]", watch: Watch = lambda process: None
    ) -> Ended:
        """Wait for the end of a job's process and note its memory."""
        end, peak = time.monotonic() + HANGS, 0.0
        try:
            while time.monotonic() < end:
                try:
                    told = process.communicate(timeout=TICK)[1].decode()
                    self.peaks[job.name] = max(self.peaks.get(job.name, 0.0), peak)
                    return Ended(process.returncode, told)
                except subprocess.TimeoutExpired:
                    peak = max(peak, memory(process.pid))
                    watch(process.pid)
            raise AssertionError(f"{job.name} hangs")
        finally:
            if process.returncode is None:
                os.killpg(process.pid, signal.SIGKILL)

    def _finish(
        self, job: Job, folder: Path, *, cache: Path | None = None, watch: Watch = lambda process: None
    ) -> Ended:
        """Let the job come to its end: its result is that of an undisturbed one."""
        ended = self._wait(job, self._start(job, folder, cache=cache), watch)
        assert ended.code == 0 and "Traceback" not in ended.told, ended
        self._sound(job, folder)
        self._whole(job, job.read(folder / job.result))
        return ended

    def _sound(self, job: Job, folder: Path) -> list[Result]:
        """What lies there of results, all of it as an undisturbed run leaves it."""
        truth = self.undisturbed[job.name].result
        found = [job.read(path) for path in (folder / job.result).parent.glob("*") if path.is_dir()]
        wrong = {name for each in found for name, content in each.items() if truth.get(name) != content}
        assert not wrong, f"{job.name} in {folder}: {sorted(wrong)} are not those of an undisturbed run"
        return found

    def _whole(self, job: Job, found: Result) -> None:
        """What was found is all of what an undisturbed run leaves."""
        truth = self.undisturbed[job.name].result
        assert found == truth, f"{job.name}: got {sorted(found)}, expected {sorted(truth)}"


def killer(ready: Callable[[], bool]) -> Watch:
    """Kills a process and its workers as soon as all is ready for that."""

    def kill(process: int) -> None:
        if ready():
            os.killpg(process, signal.SIGKILL)

    return kill


def memory(process: int) -> float:
    """Of a process and all that it started, MB; 0 if it has ended."""
    folder = Path(f"/proc/{process}")
    try:
        pages = int((folder / "statm").read_text().split()[1])
        children = [
            int(child) for file in folder.glob("task/*/children") for child in file.read_text().split()
        ]
    except (FileNotFoundError, ProcessLookupError):
        return 0.0
    return pages * resource.getpagesize() / 1e6 + sum(map(memory, children))


@contextmanager
def disk(folder: Path, size: int) -> Iterator[None]:
    """A disk of so many bytes, in memory.

    Raises:
        subprocess.CalledProcessError: if this user may not mount one.
    """
    folder.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", folder], check=True)
    try:
        yield
    finally:
        subprocess.run(["umount", "--lazy", folder], check=True)
