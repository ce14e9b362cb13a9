"""Signals: a command that is interrupted or terminated at any moment saves its results and says how to continue."""

import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from imagination.runs import sweep_jobs
from imagination.runs.checkpoint import read_state
from imagination.runs.final_record import FINAL, read_final_record
from imagination.runs.folder import LAST
from tests.conftest import ROOT, Command
from tests.runs.test_resume import points

JOB = ["+experiment=chair_unet", "scale=test"]
LATEST = Path("outputs") / "chair_unet" / "latest"
TABLES = "mapping.csv", "mapping_details.csv", "ego.csv"


def python(code: str) -> subprocess.CompletedProcess[str]:
    """Run Python code that handles signals."""
    head = "import os, signal, time\nfrom imagination.utils import interrupts\ninterrupts.install()\n"
    return subprocess.run(
        [sys.executable, "-c", head + code], env=environment(), capture_output=True, text=True, timeout=60
    )


def environment() -> dict[str, str]:
    return os.environ | {"PYTHONPATH": str(ROOT)}


def signalled(
    folder: Path, name: str, moment: str, call: int, *arguments: str
) -> subprocess.CompletedProcess[str]:
    """Run a command that receives a signal, see `tests.helpers.signalled`."""
    words = [sys.executable, "-m", "tests.helpers.signalled", name, moment, str(call), *arguments]
    return subprocess.run(
        words,
        cwd=folder,
        env=environment(),
        capture_output=True,
        text=True,
        timeout=600,
        start_new_session=True,
    )


def shown_command(stderr: str) -> list[str]:
    """Return the words after `python -m imagination.` of the only message, which tells how to continue."""
    assert "Traceback" not in stderr, stderr
    (line,) = [line for line in stderr.splitlines() if "Interrupted" in line]
    words = shlex.split(line)
    start = words.index("-m") + 1
    return [words[start].removeprefix("imagination."), *words[start + 1 :]]


def tables(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in (folder / "tables").glob("*.csv")}


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_raises_once(number: int) -> None:
    done = python(f"""
try:
    os.kill(os.getpid(), {int(number)})
except KeyboardInterrupt:
    for other in interrupts.SIGNALS:
        os.kill(os.getpid(), other)  # ignored while results are saved
    interrupts.report("Continue.")
    interrupts.report("Not reported.")
    os._exit(interrupts.exit_code())
""")
    assert done.returncode == 128 + number
    assert done.stderr.count("Interrupted") == 1 and "Continue." in done.stderr


def test_a_second_signal_ends_a_command_that_hangs() -> None:
    done = python("""
interrupts.PATIENCE = 0.1
try:
    os.kill(os.getpid(), signal.SIGTERM)
except KeyboardInterrupt:
    try:
        time.sleep(0.3)
        os.kill(os.getpid(), signal.SIGINT)
    except KeyboardInterrupt:
        os._exit(interrupts.exit_code())
""")
    assert done.returncode == 143


def test_a_signal_is_postponed_while_results_are_saved() -> None:
    done = python("""
saved = []
try:
    with interrupts.postponed():
        os.kill(os.getpid(), signal.SIGTERM)
        saved.append("context")
except KeyboardInterrupt:
    saved.append("raised")
interrupts._State.signal = None
interrupts.hold()
os.kill(os.getpid(), signal.SIGTERM)
interrupts.release()
try:
    interrupts.check()
except KeyboardInterrupt:
    saved.append("checked")
print(saved)
""")
    assert done.stdout.strip() == "['context', 'raised', 'checked']", done.stderr


def test_a_signal_does_not_disturb_the_end_of_the_interpreter() -> None:
    """The handlers of Python are gone when the objects of its modules are deleted."""
    done = python("""
import sys

class Last:
    def __del__(self, kill=os.kill, pid=os.getpid(), number=int(signal.SIGTERM)):
        kill(pid, number)

interrupts.last = Last()
sys.exit(7)
""")
    assert done.returncode == 7


def test_ignored_signals_stay_ignored() -> None:
    """As in a process that was started with nohup, or in the background of a script."""
    code = "signal.signal(signal.SIGINT, signal.SIG_IGN); interrupts.install(); os.kill(os.getpid(), signal.SIGINT)"
    assert python(code).returncode == 0


def continued(command: Command, folder: Path, stderr: str) -> None:
    """Run the command that was shown, in an empty shell."""
    done = command(*shown_command(stderr), timeout=600)
    assert done.returncode == 0, done.stderr


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Train without a signal; return the run folder."""
    folder = tmp_path_factory.mktemp("undisturbed")
    words = [sys.executable, "-m", "imagination.train", *JOB]
    subprocess.run(words, cwd=folder, env=environment(), check=True, capture_output=True, timeout=600)
    return (folder / LATEST).resolve()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "moment", "call"),
    [
        ("SIGINT", "logging", 1),
        ("SIGTERM", "logging", 2),
        ("SIGTERM", "collection", 2),
        ("SIGTERM", "training", 3),
        ("SIGTERM", "checkpoint", 2),
        ("SIGTERM", "evaluation", 2),
        ("SIGTERM", "summary", 1),
        ("SIGINT", "training", 3),
    ],
)
def test_a_stopped_training_ends_as_an_undisturbed_one(
    tmp_path: Path, command: Command, undisturbed: Path, name: str, moment: str, call: int
) -> None:
    """The same tables, weights and points of the curves; two signals, the second while the command ends."""
    done = signalled(tmp_path, name, moment, call, "train", *JOB)
    assert done.returncode == {"SIGINT": 130, "SIGTERM": 143}[name], done.stderr
    run = (tmp_path / LATEST).resolve()
    assert not (run / FINAL).exists()
    if (run / LAST).exists():
        assert (
            read_state(run / LAST)["epoch"] <= 1
        )  # complete, also if a signal came in the middle of writing
    assert shown_command(done.stderr)[:2] == ["train", f"resume={run.relative_to(tmp_path)}"]
    continued(command, tmp_path, done.stderr)
    assert read_final_record(run) == read_final_record(undisturbed) is not None
    assert tables(run) == tables(undisturbed) and set(TABLES) <= set(tables(run))
    curves, expected = (points(folder / "tensorboard") for folder in (run, undisturbed))
    missing = {tag: steps for tag, steps in expected.items() if not set(steps) <= set(curves.get(tag, []))}
    assert not missing


@pytest.mark.slow
def test_a_stopped_sweep_continues(tmp_path: Path, command: Command) -> None:
    """A sweep over two experiments, stopped in its second job."""
    words = ["-m", "+experiment=chair_unet,bed_unet", "scale=test", "hydra.sweep.dir=my sweep"]
    done = signalled(tmp_path, "SIGTERM", "checkpoint", 4, "train", *quoted(words))
    assert done.returncode == 143, done.stderr
    sweep = tmp_path / "my sweep"
    assert [job.state for job in sweep_jobs.read(sweep)] == ["done", "stopped"]
    before = (sweep / "0" / FINAL).stat().st_mtime_ns
    continued(command, tmp_path, done.stderr)
    assert [job.state for job in sweep_jobs.read(sweep)] == ["done", "done"]
    assert (sweep / "0" / FINAL).stat().st_mtime_ns == before
    assert command("train", "+experiment=bed_unet", "scale=test", timeout=600).returncode == 0
    assert tables(sweep / "1") == tables(tmp_path / "outputs" / "bed_unet" / "latest")


def quoted(words: list[str]) -> list[str]:
    """Quote values with a space for Hydra."""
    return [
        f"{key}='{value}'" if " " in value else word
        for word in words
        for key, _, value in [word.partition("=")]
    ]


@pytest.mark.slow
def test_a_stopped_evaluation_continues(tmp_path: Path, command: Command, undisturbed: Path) -> None:
    words = [f"ckpt={undisturbed}/checkpoints/best.ckpt", "hydra.run.dir=results"]
    done = signalled(tmp_path, "SIGTERM", "evaluation", 2, "evaluate", *words)
    assert done.returncode == 143, done.stderr
    assert not (tmp_path / "results" / FINAL).exists()
    continued(command, tmp_path, done.stderr)
    assert (tmp_path / "results" / FINAL).exists()
    for name in ("mapping.csv", "mapping_details.csv"):
        assert tables(tmp_path / "results")[name] == tables(undisturbed)[name]
    again = command("evaluate", *words)
    assert again.returncode == 2 and "hydra.run.dir: got results" in again.stderr


def stop(
    words: list[str], folder: Path, when: Callable[[], bool], kill: Callable[[int], None]
) -> tuple[int, str, float]:
    """Start a command, stop it as soon as `when` is true, and return its exit code, stderr and seconds to its end."""
    with open(folder / "stderr", "w") as stderr:
        process = subprocess.Popen(
            [sys.executable, "-m", *words],
            cwd=folder,
            env=environment(),
            stderr=stderr,
            start_new_session=True,
        )
        try:
            while not when():
                assert process.poll() is None, (folder / "stderr").read_text()
                time.sleep(0.02)
            start = time.monotonic()
            kill(process.pid)
            code = process.wait(60)
        finally:
            process.kill()
    return code, (folder / "stderr").read_text(), time.monotonic() - start


@pytest.mark.slow
def test_a_study_that_is_stopped_twice_continues(tmp_path: Path, command: Command) -> None:
    """Only the study's own process is signalled: it stops the training, which saves its checkpoint."""
    whole = tmp_path / "whole"
    whole.mkdir()
    long = ["trainer.max_epochs=120", "trainer.check_val_every_n_epoch=120"]
    study = ["study", "scale=test", "experiments=[chair_unet]", *long]
    words = [sys.executable, "-m", f"imagination.{study[0]}", *study[1:]]
    subprocess.run(words, cwd=whole, env=environment(), check=True, capture_output=True, timeout=900)
    last = tmp_path / LATEST / LAST
    for epoch in (10, 50):

        def trained(epoch: int = epoch) -> bool:
            return last.exists() and read_state(last)["epoch"] >= epoch

        code, stderr, seconds = stop(
            [f"imagination.{study[0]}", *study[1:]],
            tmp_path,
            trained,
            lambda pid: os.kill(pid, signal.SIGTERM),
        )
        assert code == 143 and seconds < 30, stderr
        assert read_state(last)["epoch"] < 119 and not list(tmp_path.glob("outputs/*/*/tables/mapping.csv"))
    continued(command, tmp_path, stderr)
    assert read_state(last)["epoch"] == 119
    assert len([path for path in last.parents[2].iterdir() if not path.is_symlink()]) == 1
    found, expected = (only(folder, "outputs/study/*/tables/mapping.csv") for folder in (tmp_path, whole))
    assert found.read_bytes() == expected.read_bytes()


def only(folder: Path, pattern: str) -> Path:
    (path,) = folder.glob(pattern)
    return path


@pytest.mark.slow
@pytest.mark.parametrize("victim", ["first", "second", "group"])
def test_a_stopped_distributed_training_ends_with_one_message(
    tmp_path: Path, command: Command, victim: str
) -> None:
    from tests.runs.test_distributed import TWO, child_of

    last = tmp_path / LATEST / LAST

    def kill(pid: int) -> None:
        if victim == "group":
            os.killpg(pid, signal.SIGTERM)
        else:
            os.kill(pid if victim == "first" else child_of(pid), signal.SIGTERM)

    job = ["trainer.max_epochs=100000", "trainer.check_val_every_n_epoch=100000"]
    code, stderr, seconds = stop(["imagination.train", *TWO, *job], tmp_path, last.exists, kill)
    assert code == 143 and seconds < 30, (code, stderr)
    assert shown_command(stderr)[0] == "train"
    epochs = read_state(last)["epoch"] + 2
    done = command(*shown_command(stderr), f"trainer.max_epochs={epochs}", timeout=600)
    assert done.returncode == 0, done.stderr
