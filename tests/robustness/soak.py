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
from concurrent.futures import ThreadPoolExecutor
from datetime import date
from pathlib import Path
from threading import Event, get_native_id
from types import TracebackType

import numpy as np

from imagination.checkpoints import read_state
from imagination.errors import UserError, require_extra
from imagination.geometry.camera import Camera
from imagination.geometry.grid import EgoGrid, Grid
from imagination.geometry.pose import Pose
from imagination.geometry.projection import Band, project_depth
from imagination.mapping.mapper import Mapper
from imagination.mapping.registration import MovingAverage
from imagination.runs import LAST
from imagination.scenes.renderer import Renderer
from imagination.views.poses import sample_poses
from tests.conftest import ROOT
from tests.robustness.faults import Faults, disk, jobs
from tests.robustness.page import write_part
from tests.rooms import tiny_room

FLAT = 1.1
"""How much memory may grow from the first round of faults to the last, times."""

VIEWS = 300
"""Of one pass of mapping and rendering in this process."""

HERE, LONG = "this process", "the long training"

COLUMNS = {"train": "training", "map": "mapping", "render": "rendering"}
"""Of the table: jobs."""

ROWS = (
    (
        "killed: times, kills, of which halfway in a file; times that finished work was there",
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


class LongTraining:
    """A training that runs as long as the soak does, behind everything else; its memory and its workers'."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def begin(self) -> None:
        self.folder.mkdir()
        words = "+experiment=chair_unet", "scale=test", "scale.rounds=1000000", "scale.eval_every=200"
        self.process = subprocess.Popen(
            [sys.executable, "-m", "imagination.train", *words],
            env=os.environ | {"PYTHONPATH": str(ROOT)},
            cwd=self.folder,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
            preexec_fn=lambda: os.nice(15),
        )
        self.checkpoint = self.folder / "outputs" / "chair_unet" / "latest" / LAST

    def rounds(self) -> int:
        """Done so far."""
        assert self.process.poll() is None, "the long training has ended"
        return int(read_state(self.checkpoint)["epoch"]) + 1 if self.checkpoint.is_file() else 0

    def memory(self) -> float:
        """Of all its processes, MB."""
        processes = [path for path in Path("/proc").glob("[0-9]*") if group_of(path) == self.process.pid]
        return sum(resident(path) for path in processes)

    def end(self) -> None:
        os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()


def group_of(process: Path) -> int:
    """Process group of a folder in /proc; 0 if it is gone."""
    try:
        return int((process / "stat").read_text().rpartition(")")[2].split()[2])
    except (FileNotFoundError, ProcessLookupError):
        return 0


class Soak:
    """One soak in a folder of its own.

    Args:
        folder: for caches and outputs.
        seed: of the moments at which things break.
    """

    def __init__(self, folder: Path, seed: int) -> None:
        self.faults, self.jobs, self.left_out = Faults(folder, seed), jobs(folder), []
        try:
            require_extra("litdata", "shards")
        except UserError as error:
            self.left_out.append(f"Rendering is left out: {error}.")
            self.jobs = [job for job in self.jobs if job.name != "render"]
        try:
            with disk(folder / "disk", 4096):
                self.mounts = True
        except (subprocess.CalledProcessError, FileNotFoundError) as error:
            self.mounts = False
            self.left_out.append(f"Small disks are left out: {error}.")
        self.rounds: list[dict[str, float]] = []  # memory, MB
        for job in self.jobs:
            self.faults.nothing(job)
        self.long = LongTraining(folder / "long")
        self.trained: list[int] = []  # rounds of the long training, after each round of faults

    def run(self, minutes: float, meanwhile: Meanwhile) -> None:
        """Break things, round by round, until time is up."""
        end = time.monotonic() + 60 * minutes
        self.long.begin()
        try:
            while time.monotonic() < end:
                self.faults.peaks.clear()
                meanwhile.peak = 0.0
                self.round(meanwhile)
                self.rounds.append({**self.faults.peaks, HERE: meanwhile.peak, LONG: self.long.memory()})
                self.trained.append(self.long.rounds())
        finally:
            self.long.end()

    def round(self, meanwhile: Meanwhile) -> None:
        """Do everything to every job once."""
        faults, folder = self.faults, self.faults.folder / "now"
        full = faults.full_disk if self.mounts and len(self.rounds) % 2 else faults.limited  # in turn
        for fault in (faults.killed, full, faults.damaged, faults.shared):
            for job in self.jobs:
                if job.cached or fault not in (faults.damaged, faults.shared):
                    begin = time.monotonic()
                    fault(job, folder)
                    print(f"{fault.__name__} {job.name}: {time.monotonic() - begin:.0f} s", flush=True)
                    faults.count[fault.__name__, job.name] += 1
                    shutil.rmtree(folder)
                    meanwhile.check()

    def grown(self) -> list[str]:
        """Whose memory did not stay flat."""
        first, last = self.rounds[0], self.rounds[-1]
        told = {name: f"{name}: {first[name]:.0f} to {last[name]:.0f} MB" for name in first}
        return [told[name] for name in first if last[name] > FLAT * first[name]]

    def table(self) -> list[str]:
        """What was done how often to which job, and the memory that it took."""
        count, first, last = self.faults.count, self.rounds[0], self.rounds[-1]

        def cell(job: str, counted: tuple[str, ...]) -> str:
            numbers = [str(count[what, job]) for what in counted]
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


def resident(process: Path = Path("/proc/self")) -> float:
    """Memory of a process now, MB; 0 if it has ended."""
    try:
        pages = int((process / "statm").read_text().split()[1])
    except (FileNotFoundError, ProcessLookupError):
        return 0.0
    return pages * resource.getpagesize() / 1e6


def main(words: list[str]) -> None:
    """Soak for the minutes asked for and tell what happened."""
    values = {"minutes": 20.0, "seed": 0.0} | {
        key: float(value) for key, _, value in (word.partition("=") for word in words)
    }
    with tempfile.TemporaryDirectory() as folder:
        soak = Soak(Path(folder), int(values["seed"]))
        with Meanwhile() as meanwhile:
            soak.run(values["minutes"], meanwhile)
        meanwhile.check()
    here, long = ([each[name] for each in soak.rounds] for name in (HERE, LONG))
    text = "\n".join(
        [
            f"{date.today()}: {values['minutes']:g} minutes, {len(soak.rounds)} rounds, seed {values['seed']:g}.",
            *soak.left_out,
            "",
            *soak.table(),
            "",
            f"Meanwhile one process rendered and mapped the same {VIEWS} views {meanwhile.passes} times, always with "
            f"the same images and map, with {here[0]:.0f} MB in the first round and {here[-1]:.0f} in the last. Behind "
            f"them one training went on: {long[0]:.0f} MB with its workers after its round {soak.trained[0]}, "
            f"{long[-1]:.0f} after its round {soak.trained[-1]}.",
        ]
    )
    print(text, *soak.rounds, sep="\n")
    assert len(soak.trained) == 1 or 0 < soak.trained[0] < soak.trained[-1], (
        f"the long training stood still: {soak.trained}"
    )
    assert not soak.grown(), f"memory grew: {', '.join(soak.grown())}"
    met = {job.name: soak.faults.count["found", job.name] for job in soak.jobs if job.cached}
    assert all(met.values()), (
        f"no damaged entry was met: {met}; was the code, and so the cache's keys, changed meanwhile?"
    )
    write_part("soak", text)


if __name__ == "__main__":
    main(sys.argv[1:])
