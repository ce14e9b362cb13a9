"""Worker processes for work on scenes: each scene has its own worker, which loads it once."""

import os
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor
from multiprocessing import get_context, parent_process
from signal import SIG_IGN, SIGINT, signal
from threading import Thread
from typing import Any, Concatenate, ParamSpec, TypeVar

import cv2

from imagination.errors import check_range
from imagination.views.view import Observer

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
        if self._workers:
            owner = self._worker_of.setdefault(scene, len(self._worker_of) % len(self._workers))
            return self._workers[owner].submit(_call, function, scene, args, kwargs)
        future: Future[T] = Future()
        future.set_result(function(self.observer, scene, *args, **kwargs))
        return future

    def close(self) -> None:
        """Stop the workers; work that has not begun is dropped."""
        for worker in self._workers:
            worker.shutdown(wait=True, cancel_futures=True)


def _start(observer: Observer) -> None:
    global _observer
    _observer = observer
    cv2.setNumThreads(1)  # one worker, one core
    signal(SIGINT, SIG_IGN)  # Ctrl-C is for the main process, which stops its workers
    os.nice(5)  # training in the main process goes first
    Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """A killed main process cannot stop its workers: they would wait for work for ever."""
    parent = parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _call(function: Callable[..., T], scene: str, args: tuple[Any, ...], kwargs: dict[str, Any]) -> T:
    assert _observer is not None
    return function(_observer, scene, *args, **kwargs)
