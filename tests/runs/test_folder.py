"""Run folders: exclusive creation, atomic files, locks and log files."""

import errno
import logging
import multiprocessing
import random
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path

import pytest

from imagination.runs.folder import COMPOSED, create_folder, find_latest, point_latest, restore_latest
from imagination.runs.locking import locked
from imagination.runs.logging import FILE_ONLY, logging_to
from imagination.utils import atomic_io
from imagination.utils.atomic_io import replacing, write_text
from imagination.utils.errors import UserError
from tests.conftest import ROOT


def test_folders_are_never_shared(tmp_path: Path) -> None:
    with ThreadPoolExecutor(8) as pool:
        folders = list(pool.map(lambda _: create_folder(tmp_path / "a", "run"), range(20)))
    assert len(set(folders)) == 20
    assert {folder.name for folder in folders} == {"run", *(f"run_{number}" for number in range(1, 20))}


def test_latest_is_replaced(tmp_path: Path) -> None:
    for name in ("1", "2"):
        point_latest(create_folder(tmp_path, name))
        assert (tmp_path / "latest").resolve() == tmp_path / name
    assert sorted(path.name for path in tmp_path.iterdir()) == ["1", "2", "latest"]


def start(parent: Path, seed: int) -> None:
    """Point `latest` to new folders, some of which are refused, while all temporary folders count as stale."""
    atomic_io.STALE_SECONDS = -1.0
    rng = random.Random(seed)
    for _ in range(40):
        folder = create_folder(parent, "run")
        previous = point_latest(folder)
        if rng.random() < 0.3:
            restore_latest(folder, previous)


def test_simultaneous_starts_never_fail(tmp_path: Path) -> None:
    with ProcessPoolExecutor(8, mp_context=multiprocessing.get_context("fork")) as pool:
        list(pool.map(start, [tmp_path] * 8, range(8)))
    assert (tmp_path / "latest").resolve().parent == tmp_path
    assert not list(tmp_path.glob(".*.part"))


def test_newest_run_is_found(tmp_path: Path) -> None:
    for name, stamp in (("a", "2026-01-01"), ("b", "2026-01-03"), ("a", "2026-01-02")):
        folder = create_folder(tmp_path / name, stamp)
        write_text(folder / COMPOSED, "{}")
        point_latest(folder)
    assert find_latest(tmp_path, None).name == "2026-01-03"
    assert find_latest(tmp_path, "a").name == "2026-01-02"
    with pytest.raises(UserError, match="resume=latest: .*'c'"):
        find_latest(tmp_path, "c")


def test_an_error_leaves_the_old_file(tmp_path: Path) -> None:
    write_text(tmp_path / "x", "old")
    with pytest.raises(RuntimeError), replacing(tmp_path / "x") as temporary:
        temporary.write_text("half")
        raise RuntimeError
    assert (tmp_path / "x").read_text() == "old"
    assert [path.name for path in tmp_path.iterdir()] == ["x"]


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EROFS])
def test_a_full_disk_is_reported(tmp_path: Path, number: int) -> None:
    with pytest.raises(UserError, match=r"could not write .*table\.csv"):
        with replacing(tmp_path / "table.csv"):
            raise OSError(number, "no space")
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_checkpoint_on_a_full_disk_is_reported_and_keeps_the_old_one(tmp_path: Path) -> None:
    code = f"""
import resource, torch
from pathlib import Path
from imagination.runs.checkpoint import CheckpointFiles
from imagination.utils.errors import UserError
path = Path({str(tmp_path)!r}) / "last.ckpt"
CheckpointFiles().save_checkpoint({{"x": 1}}, path)
resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))
import signal; signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
try:
    CheckpointFiles().save_checkpoint({{"x": torch.zeros(1_000_000)}}, path)
except UserError as error:
    print(error)
assert torch.load(path) == {{"x": 1}}
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert "could not write" in done.stdout
    assert [path.name for path in tmp_path.iterdir()] == ["last.ckpt"]


def test_two_processes_never_lock_one_run(tmp_path: Path) -> None:
    context = multiprocessing.get_context("spawn")
    with locked(tmp_path), context.Pool(1) as pool:
        assert "another process" in pool.apply(try_lock, (tmp_path,))
    assert try_lock(tmp_path) == ""


def try_lock(folder: Path) -> str:
    try:
        with locked(folder):
            return ""
    except UserError as error:
        return str(error)


def test_messages_go_to_the_log(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with logging_to(tmp_path / "run.log"):
        logging.getLogger("x").info("hello")
        logging.getLogger("x").error("for the record", extra=FILE_ONLY)
    logging.getLogger("x").info("too late")
    text = (tmp_path / "run.log").read_text()
    assert "INFO x: hello" in text and "for the record" in text and "too late" not in text
    shown = capsys.readouterr().err
    assert "hello" in shown and "for the record" not in shown


def test_a_log_that_cannot_be_written_does_not_end_the_run(capfd: pytest.CaptureFixture[str]) -> None:
    """A full disk is reported by the writer of the results."""
    with logging_to(Path("/dev/full")):
        logging.getLogger("full").warning("a message")
    stderr = capfd.readouterr().err
    assert "a message" in stderr and "Traceback" not in stderr
