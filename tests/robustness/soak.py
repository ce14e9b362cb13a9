"""`make soak`, or `python -m tests.robustness.soak [minutes=20] [seed=0]`: faults, one after another, until time is up.

Training, mapping and rendering are killed, run out of disk, find damaged entries in the cache, share a cache; each must
end with the result of an undisturbed run. Meanwhile a thread of this process maps and renders, whose result must stay
the same and whose memory must stay flat, as that of all processes must.
"""

import hashlib
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from datetime import date
from pathlib import Path
from threading import Event, get_native_id
from types import TracebackType

import numpy as np

from imagination.geometry.camera import Camera
from imagination.geometry.grid import EgoGrid, Grid
from imagination.geometry.pose import Pose
from imagination.geometry.projection import Band, project_depth
from imagination.mapping.mapper import Mapper
from imagination.mapping.update_rules import MovingAverage
from imagination.runs.checkpoint import read_state
from imagination.runs.folder import LAST
from imagination.scenes.renderer import Renderer
from imagination.views.pose_samplers import sample_poses
from tests.conftest import ROOT
from tests.helpers.rooms import tiny_room
from tests.robustness.faults import Faults, disk, jobs, memory
from tests.robustness.page import write_part

FLAT = 1.1
"""How much memory may grow from the first round of faults to the last, times."""

VIEWS = 300
"""Of one pass of mapping and rendering in this process."""

HERE = "this process"

TEST = "scale=test", "scale.workers=1"
TRAIN_ON = "train", "+experiment=chair_unet", *TEST, "scale.epochs=1000000", "scale.eval_every=200"
RENDER_ON = "prepare_shards", "shards=corpus", *TEST, "scale.scenes.train=9999", "views=16"
"""What goes on behind the faults."""

COLUMNS = {"train": "training", "map": "mapping", "prepare_shards": "rendering"}
"""Of the table: jobs."""

ROWS = (
    (
        "killed: times, kills, of which halfway in a file; times that it found finished work",
        ("killed", "kills", "halfway", "kept"),
        "goes on to that result; none of that work is done again",
    ),
    ("no file beyond a random limit", ("limited",), "one message, code 2; without it, that result"),
    ("a disk of random size, too small", ("full_disk",), "one message, code 2; with more room, that result"),
    ("cache damaged under it: times, entries met", ("damaged", "found"), "made again; that result"),
    ("two at once on one empty cache", ("shared",), "that result twice"),
)
"""Of the table: what is done, its counts, the outcome."""


class Meanwhile:
    """Renders, projects and registers views in a thread, again and again: always the same ones.

    Attributes:
        passes: done so far.
        peak: memory of this process since it was set to 0 last, MB.
    """

    def __init__(self) -> None:
        self.passes, self.peak = 0, 0.0
        self.truth = self._pass()
        self._stop = Event()
        self._thread = ThreadPoolExecutor(1)

    def __enter__(self) -> "Meanwhile":
        self._task = self._thread.submit(self._run)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        self._thread.shutdown()

    def check(self) -> None:
        """Raise what went wrong in the thread."""
        if self._task.done():
            self._task.result()

    def _run(self) -> None:
        os.setpriority(os.PRIO_PROCESS, get_native_id(), 10)  # of this thread: the jobs go first
        while not self._stop.is_set():
            assert self._pass() == self.truth, "mapping and rendering gave another result than at first"
            self.passes += 1
            self.peak = max(self.peak, resident())

    def _pass(self) -> str:
        """Hash of all images and of the map that they give."""
        room, digest = tiny_room(), hashlib.sha256()
        renderer, camera = Renderer(room.mesh, room.lighting), Camera.from_degrees(64, 64, 90.0, 1.25)
        ego = EgoGrid.of_extent(3.72, 0.06)
        mapper = Mapper(Grid.centred(20.0, 0.06), ego, ["chair"], MovingAverage(0.9))
        for pose in sample_poses(room.free_space, VIEWS, np.random.default_rng(0)):
            image = renderer.render(camera, camera.to_world(pose, 0.0))
            view = project_depth(image.depth, camera, ego, Band(0.2, 1.5))
            mapper.register(view.occupied[None].astype(np.float32), view.seen[None], Pose(*pose))
            digest.update(image.rgb.tobytes() + image.depth.tobytes() + image.instance.tobytes())
        assert mapper.written.any() and mapper.probabilities.any()
        digest.update(mapper.probabilities.tobytes() + mapper.written.tobytes())
        return digest.hexdigest()


class Long:
    """A command that goes on as long as the soak does, behind everything else.

    Args:
        name: for messages.
        folder: it runs in.
        words: the module's name and what it is asked to do.
        done: how much of that, by what lies in the folder.
    """

    def __init__(self, name: str, folder: Path, words: Sequence[str], done: Callable[[Path], int]) -> None:
        self.name, self.folder, self.words, self.done = name, folder, words, done
        self.steps: list[int] = []  # after each round of faults

    def begin(self) -> None:
        self.folder.mkdir()
        with open(self.folder / "told", "w") as told:
            self.process = subprocess.Popen(
                [sys.executable, "-m", f"imagination.{self.words[0]}", *self.words[1:]],
                env=os.environ | {"PYTHONPATH": str(ROOT)},
                cwd=self.folder,
                stdout=subprocess.DEVNULL,
                stderr=told,
                start_new_session=True,
                preexec_fn=lambda: os.nice(15),
            )

    def look(self) -> float:
        """Note how far it is; the memory of all its processes, MB."""
        assert self.process.poll() is None, f"{self.name} has ended: {(self.folder / 'told').read_text()}"
        self.steps.append(self.done(self.folder))
        return memory(self.process.pid)

    def end(self) -> None:
        with suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()


def epochs(folder: Path) -> int:
    """Of the training in a folder."""
    checkpoint = folder / "outputs" / "chair_unet" / "latest" / LAST
    return int(read_state(checkpoint)["epoch"]) + 1 if checkpoint.is_file() else 0


def scenes(folder: Path) -> int:
    """Of the corpus in a folder."""
    return sum(1 for _ in folder.glob("corpus/*.record.json"))


class Soak:
    """One soak in a folder of its own.

    Args:
        folder: for caches and outputs.
        seed: of the moments at which things break.
    """

    def __init__(self, folder: Path, seed: int) -> None:
        self.faults, self.jobs, self.left_out = Faults(folder, seed), jobs(folder), []
        try:
            with disk(folder / "disk", 4096):
                self.mounts = True
        except (subprocess.CalledProcessError, FileNotFoundError) as error:
            self.mounts = False
            self.left_out.append(f"Small disks are left out: {error}.")
        self.epochs: list[dict[str, float]] = []  # memory, MB
        for job in self.jobs:
            self.faults.nothing(job)
        self.longs = [
            Long("one training", folder / "train_on", TRAIN_ON, epochs),
            Long("one rendering", folder / "render_on", RENDER_ON, scenes),
        ]

    def run(self, minutes: float, meanwhile: Meanwhile) -> None:
        """Break things, round by round, until time is up."""
        end = time.monotonic() + 60 * minutes
        for long in self.longs:
            long.begin()
        try:
            while time.monotonic() < end:
                self.faults.peaks.clear()
                meanwhile.peak = 0.0
                self.round(meanwhile)
                held = {long.name: long.look() for long in self.longs}
                self.epochs.append({**self.faults.peaks, HERE: meanwhile.peak, **held})
        finally:
            for long in self.longs:
                long.end()

    def round(self, meanwhile: Meanwhile) -> None:
        """Do everything to every job once."""
        faults, folder = self.faults, self.faults.folder / "now"
        full = faults.full_disk if self.mounts and len(self.epochs) % 2 else faults.limited  # in turn
        for fault in (faults.killed, full, faults.damaged, faults.shared):
            for job in self.jobs:
                if job.cached or fault not in (faults.damaged, faults.shared):
                    begin = time.monotonic()
                    fault(job, folder)
                    print(f"{fault.__name__} {job.name}: {time.monotonic() - begin:.0f} s", flush=True)
                    faults.count[fault.__name__, job.name] += 1
                    shutil.rmtree(folder)
                    meanwhile.check()

    def check(self) -> None:
        """Raise if memory grew, what goes on stood still, or nothing was there to be met."""
        first, last = self.epochs[0], self.epochs[-1]
        told = {name: f"{name}: {first[name]:.0f} to {last[name]:.0f} MB" for name in first}
        grown = [told[name] for name in first if last[name] > FLAT * first[name]]
        assert not grown, f"memory grew: {', '.join(grown)}"
        for long in self.longs:
            steps = long.steps
            assert len(steps) == 1 or 0 < steps[0] < steps[-1], f"{long.name} stood still: {steps}"
        cached = [job.name for job in self.jobs if job.cached]
        never = [
            (what, job) for what in ("found", "kept") for job in cached if not self.faults.count[what, job]
        ]
        assert not never, (
            f"no damaged entry was met, or no finished work was there: {never}; was the code, and so the cache's "
            "keys, changed meanwhile?"
        )

    def behind(self, passes: int) -> list[str]:
        """What went on behind the faults."""
        first, last = self.epochs[0], self.epochs[-1]
        return [
            f"Meanwhile one process rendered and mapped the same {VIEWS} views {passes} times, always with the same "
            f"images and map, with {first[HERE]:.0f} MB in the first round and {last[HERE]:.0f} in the last. Behind "
            "them went on:",
            "",
            *(
                f"- {long.name}: {first[long.name]:.0f} MB with its workers after {long.steps[0]} "
                f"{long.done.__name__}, {last[long.name]:.0f} after {long.steps[-1]}."
                for long in self.longs
            ),
        ]

    def table(self) -> list[str]:
        """What was done how often to which job, and the memory that it took."""
        count, first, last = self.faults.count, self.epochs[0], self.epochs[-1]

        def cell(job: str, counted: tuple[str, ...]) -> str:
            numbers = [str(count[what, job]) if (what, job) in count else "–" for what in counted]
            return ", ".join(numbers) if count[counted[0], job] else "–"

        memory = [f"{first[job]:.0f}, {last[job]:.0f}" if job in first else "–" for job in COLUMNS]
        rows = [
            ("what", *COLUMNS.values(), "outcome"),
            ("---",) * 5,
            *((what, *(cell(job, counted) for job in COLUMNS), outcome) for what, counted, outcome in ROWS),
            (
                "peak memory in the first and the last round, MB",
                *memory,
                f"grows by less than {FLAT - 1:.0%}",
            ),
        ]
        return ["| " + " | ".join(row) + " |" for row in rows]


def resident() -> float:
    """Memory of this process alone now, MB."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 1e6


def main(words: list[str]) -> None:
    """Soak for the minutes asked for and tell what happened."""
    values = {"minutes": 20.0, "seed": 0.0}
    for key, _, value in (word.partition("=") for word in words):
        if key not in values:
            sys.exit(f"soak: got {key}, expected minutes=… or seed=…")
        values[key] = float(value)
    with tempfile.TemporaryDirectory() as folder:
        soak = Soak(Path(folder), int(values["seed"]))
        with Meanwhile() as meanwhile:
            soak.run(values["minutes"], meanwhile)
        meanwhile.check()
    text = "\n".join(
        [
            f"{date.today()}: {values['minutes']:g} minutes, {len(soak.epochs)} epochs, seed {values['seed']:g}.",
            *soak.left_out,
            "",
            *soak.table(),
            "",
            *soak.behind(meanwhile.passes),
        ]
    )
    print(text, *soak.epochs, sep="\n")
    soak.check()
    write_part("soak", text)


if __name__ == "__main__":
    main(sys.argv[1:])
