"""Worker processes for work on scenes: each scene has its own worker, which loads it once."""

import logging
import os
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import get_context, parent_process, resource_tracker
from signal import SIG_BLOCK, SIG_IGN, SIG_SETMASK, SIGINT, pthread_sigmask, signal
from threading import Thread
from typing import Any, Concatenate, NamedTuple, ParamSpec, TypeVar

import cv2

from imagination.utils.errors import WorkerDiedError, check_range
from imagination.views.observer import Observer

DIED = "workers: a process was killed, as for want of memory, or crashed; take fewer with scale.workers"

P = ParamSpec("P")
T = TypeVar("T")

_observer: Observer | None = None  # the worker process's copy


class ScenePool:
    """Calls `function(observer, scene, ...)` in the worker that holds the scene.

    What a function returns may depend on its arguments only, so that the number of workers changes nothing.

    Args:
        observer: copied into each worker.
        workers: processes; 0 runs everything in this one, at the call.
    """

    def __init__(self, observer: Observer, workers: int) -> None:
        check_range("workers", workers, 0, 1024)
        self.observer = observer
        context = get_context("spawn")  # a fork would copy torch's threads in a broken state
        self._workers = [
            ProcessPoolExecutor(1, mp_context=context, initializer=_start, initargs=(observer,))
            for _ in range(workers)
        ]
        self._worker_of: dict[str, int] = {}

    @property
    def ahead(self) -> int:
        """How many more tasks to submit than are waited for, so that no worker is idle."""
        return 2 * len(self._workers)

    def submit(
        self,
        function: Callable[Concatenate[Observer, str, P], T],
        scene: str,
        *args: P.args,
        **kwargs: P.kwargs,
    ) -> "Future[T]":
        """Start `function(observer, scene, *args, **kwargs)`; it must be importable from a module."""
        future: Future[T] = Future()
        if self._workers:
            owner = self._worker_of.setdefault(scene, len(self._worker_of) % len(self._workers))
            with _no_interrupt():  # the first call starts the process
                try:
                    answer = self._workers[owner].submit(_call, function, scene, args, kwargs)
                except BrokenProcessPool as error:
                    raise WorkerDiedError(DIED) from error
            _leave_answers_to_the_worker(self._workers[owner])
            answer.add_done_callback(lambda done: _deliver(done, future))
        else:
            future.set_result(function(self.observer, scene, *args, **kwargs))
        return future

    def close(self) -> None:
        """Stop the workers at once; work that has not ended is dropped."""
        for worker in self._workers:
            for process in list((worker._processes or {}).values()):
                process.kill()  # Python 3.14 has worker.kill_workers() for this
            worker.shutdown(wait=True, cancel_futures=True)


class _Answer(NamedTuple):
    """What a worker sends back: the result and what it logged meanwhile. An error carries its `records` itself."""

    result: Any
    records: list[logging.LogRecord]


class _Records(logging.Handler):
    """Keeps messages in a form that can be sent."""

    def __init__(self) -> None:
        super().__init__()
        self.kept: list[logging.LogRecord] = []

    def emit(self, record: logging.LogRecord) -> None:
        record.msg, record.args, record.exc_info = self.format(record), None, None
        self.kept.append(record)


_records = _Records()  # of the worker process


def _deliver(answer: "Future[_Answer]", future: "Future[Any]") -> None:
    """Hand over what a worker sent: its messages go to the loggers of this process, and so to the run's log."""
    if answer.cancelled():
        future.cancel()
        return
    error = answer.exception()
    for record in answer.result().records if error is None else vars(error).get("records", []):
        logging.getLogger(record.name).handle(record)
    if error is None:
        future.set_result(answer.result().result)
    else:
        future.set_exception(WorkerDiedError(DIED) if isinstance(error, BrokenProcessPool) else error)


def _leave_answers_to_the_worker(worker: ProcessPoolExecutor) -> None:
    """Close this process's end for writing answers: a worker that is killed while it writes one is noticed then.

    With it open, the rest of the answer would be waited for for ever.
    """
    answers: Any = worker._result_queue
    if not answers._writer.closed:
        answers._writer.close()


@contextmanager
def _no_interrupt() -> Iterator[None]:
    """Processes started meanwhile never get Ctrl-C, which is for the main process; there it waits until the end."""
    resource_tracker.ensure_running()  # starting it would let interrupts through again
    before = pthread_sigmask(SIG_BLOCK, [SIGINT])
    try:
        yield
    finally:
        pthread_sigmask(SIG_SETMASK, before)


def _start(observer: Observer) -> None:
    global _observer
    _observer = observer
    cv2.setNumThreads(1)  # one worker, one core
    signal(SIGINT, SIG_IGN)
    os.nice(5)  # training in the main process goes first
    logging.getLogger().addHandler(_records)
    logging.captureWarnings(True)
    Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """A killed main process cannot stop its workers: they would wait for work for ever."""
    parent = parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _call(function: Callable[..., Any], scene: str, args: tuple[Any, ...], kwargs: dict[str, Any]) -> _Answer:
    assert _observer is not None
    _records.kept = []
    try:
        return _Answer(function(_observer, scene, *args, **kwargs), _records.kept)
    except Exception as error:
        vars(error)["records"] = _records.kept
        raise
