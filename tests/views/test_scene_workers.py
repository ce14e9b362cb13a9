"""Worker processes: results, errors and warnings are returned, and closing does not wait for tasks."""

import logging
import os
import time
import warnings
from multiprocessing.connection import Connection
from pathlib import Path
from signal import SIGKILL

import pytest

from imagination.utils.errors import UserError, WorkerDiedError
from imagination.views.observer import Observer
from imagination.views.scene_workers import ScenePool
from tests.data.test_datamodule import observer


def warned(observer: Observer, scene: str, fails: bool) -> str:
    logging.getLogger("imagination.somewhere").warning("%s is odd", scene)
    logging.getLogger("imagination.somewhere").info("below the level of the log")
    warnings.warn(f"deprecated object {fails}", stacklevel=1)  # each text is shown once
    if fails:
        raise UserError(f"scene: got {scene}")
    return scene.upper()


def slow(observer: Observer, scene: str, started: Path) -> None:
    started.touch()
    time.sleep(600)


@pytest.mark.slow
def test_warnings_of_workers_reach_the_logs_of_the_main_process(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    pool = ScenePool(observer(tmp_path), 1)
    try:
        for fails in (False, True):
            caplog.clear()
            future = pool.submit(warned, "train_0", fails)
            if fails:
                with pytest.raises(UserError, match="got train_0"):
                    future.result()
            else:
                assert future.result() == "TRAIN_0"
            messages = [(record.name, record.levelname, record.getMessage()) for record in caplog.records]
            assert messages[0] == ("imagination.somewhere", "WARNING", "train_0 is odd")
            assert messages[1][0] == "py.warnings" and "deprecated object" in messages[1][2]
            assert len(messages) == 2
    finally:
        pool.close()


def die_while_sending(observer: Observer, scene: str) -> bytes:
    def half(connection: Connection, message: memoryview) -> None:
        os.write(connection.fileno(), bytes(message)[: len(message) // 2])
        os.kill(os.getpid(), SIGKILL)

    Connection._send = half  # type: ignore[assignment, method-assign]
    return bytes(1000)


def test_a_worker_killed_while_it_sends_a_result_is_noticed(tmp_path: Path) -> None:
    """As when the kernel kills it for its memory: the rest of the result never arrives."""
    pool = ScenePool(observer(tmp_path), workers=1)
    try:
        for _ in range(2):  # tasks submitted later fail as well
            with pytest.raises(WorkerDiedError, match="data.workers"):
                pool.submit(die_while_sending, "one").result(timeout=60)
    finally:
        pool.close()


@pytest.mark.slow
def test_closing_does_not_wait_for_tasks(tmp_path: Path) -> None:
    pool = ScenePool(observer(tmp_path), 1)
    futures = [pool.submit(slow, "train_0", tmp_path / "started") for _ in range(3)]
    while not (tmp_path / "started").exists():
        time.sleep(0.05)
    start = time.monotonic()
    pool.close()
    assert time.monotonic() - start < 5
    assert not any(
        future.done() and future.exception() is None for future in futures if not future.cancelled()
    )
