"""Worker processes for tasks on scenes: all tasks of a scene run in one worker, which loads the scene once."""

import logging
import os
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import get_context, parent_process, resource_tracker
from signal import SIG_BLOCK, SIG_IGN, SIG_SETMASK, pthread_sigmask, signal
from threading import Thread
from typing import Any, Concatenate, NamedTuple, ParamSpec, TypeVar

import cv2

from imagination.utils.errors import WorkerDiedError, check_range
from imagination.utils.interrupts import SIGNALS
from imagination.views.observer import Observer

WORKER_DIED = "workers: a worker process died, possibly out of memory; reduce data.workers"
"""Message of the `WorkerDiedError`."""

P = ParamSpec("P")
T = TypeVar("T")

_observer: Observer | None = None  # in a worker process: its copy of the observer


class ScenePool:
    """Pool of worker processes that call `function(observer, scene, ...)`, always in the same worker for a scene.

    The result of a function must depend on its arguments only, so that it does not depend on the number of workers.

    Args:
        observer: observer that is copied to each worker.
        workers: number of worker processes; 0 runs each task in the calling process when it is submitted.
    """

    def __init__(self, observer: Observer, workers: int) -> None:
        check_range("workers", workers, 0, 1024)
        self.observer = observer
        context = get_context("spawn")  # forking breaks the threads of PyTorch
        self._workers = [
            ProcessPoolExecutor(1, mp_context=context, initializer=_start, initargs=(observer,))
            for _ in range(workers)
        ]
        self._worker_of: dict[str, int] = {}

    @property
    def ahead(self) -> int:
        """Number of tasks to submit ahead of the results, so that no worker is idle."""
        return 2 * len(self._workers)

    def submit(
        self,
        function: Callable[Concatenate[Observer, str, P], T],
        scene: str,
        *args: P.args,
        **kwargs: P.kwargs,
    ) -> "Future[T]":
        """Submit `function(observer, scene, *args, **kwargs)`; the function must be importable."""
        future: Future[T] = Future()
        if self._workers:
            index = self._worker_of.setdefault(scene, len(self._worker_of) % len(self._workers))
            with _no_interrupt():  # the worker process starts with its first task
                try:
                    result = self._workers[index].submit(_call, function, scene, args, kwargs)
                except BrokenProcessPool as error:
                    raise WorkerDiedError(WORKER_DIED) from error
            _close_result_writer(self._workers[index])
            result.add_done_callback(lambda done: _forward(done, future))
        else:
            future.set_result(function(self.observer, scene, *args, **kwargs))
        return future

    def close(self) -> None:
        """Stop the workers immediately and drop unfinished tasks."""
        for worker in self._workers:
            for process in list((worker._processes or {}).values()):
                process.kill()  # Python 3.14 has worker.kill_workers() for this
            worker.shutdown(wait=True, cancel_futures=True)


class _Result(NamedTuple):
    """Result of a task with the log records of the worker; an exception carries its `records` as an attribute."""

    value: Any
    records: list[logging.LogRecord]


class _Records(logging.Handler):
    """Logging handler that keeps records in a picklable form."""

    def __init__(self) -> None:
        super().__init__()
        self.records: list[logging.LogRecord] = []

    def emit(self, record: logging.LogRecord) -> None:
        record.msg, record.args, record.exc_info = self.format(record), None, None
        self.records.append(record)


_records = _Records()  # in a worker process: log records of the current task


def _forward(result: "Future[_Result]", future: "Future[Any]") -> None:
    """Forward the result of a worker to `future`, and its log records to the loggers of this process."""
    if result.cancelled():
        future.cancel()
        return
    error = result.exception()
    for record in result.result().records if error is None else vars(error).get("records", []):
        logging.getLogger(record.name).handle(record)
    if error is None:
        future.set_result(result.result().value)
    else:
        future.set_exception(WorkerDiedError(WORKER_DIED) if isinstance(error, BrokenProcessPool) else error)


def _close_result_writer(worker: ProcessPoolExecutor) -> None:
    """Close the write end of the result queue in this process.

    While it is open, reading a result blocks forever if the worker is killed while writing it.
    """
    queue: Any = worker._result_queue
    if not queue._writer.closed:
        queue._writer.close()


@contextmanager
def _no_interrupt() -> Iterator[None]:
    """Block signals that end the command: child processes inherit the mask, and the main process handles them later."""
    resource_tracker.ensure_running()  # starting it later would unblock them
    mask = pthread_sigmask(SIG_BLOCK, SIGNALS)
    try:
        yield
    finally:
        pthread_sigmask(SIG_SETMASK, mask)


def _start(observer: Observer) -> None:
    """Initialize the worker process."""
    global _observer
    _observer = observer
    cv2.setNumThreads(1)  # one core for each worker
    for number in SIGNALS:
        signal(number, SIG_IGN)
    os.nice(5)  # training in the main process has priority
    logging.getLogger().addHandler(_records)
    logging.captureWarnings(True)
    Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """Exit when the main process ends, because a killed main process cannot stop its workers."""
    parent = parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _call(function: Callable[..., Any], scene: str, args: tuple[Any, ...], kwargs: dict[str, Any]) -> _Result:
    """Run a task in the worker process and return its result with the log records."""
    assert _observer is not None
    _records.records = []
    try:
        return _Result(function(_observer, scene, *args, **kwargs), _records.records)
    except Exception as error:
        vars(error)["records"] = _records.records
        raise
