"""Where the shards run: in this process, in several, or on a Dask cluster. Results always come in order."""

from __future__ import annotations

import importlib
import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from itertools import islice
from multiprocessing.process import BaseProcess
from types import TracebackType
from typing import Any, Protocol, Self, TypeVar

from pipeline.engine.errors import MissingPartError, ResourceError, UsageError
from pipeline.engine.threads import limit_threads

Item = TypeVar("Item")
Result = TypeVar("Result")


def usable_cores() -> int:
    """Processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Executor(Protocol):
    """Applies a function to items; the results come in the items' order, whatever runs where."""

    def map(self, function: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
        """Results in order; an exception in a worker is raised here."""

    def __enter__(self) -> Self:
        """Workers start when they are first needed."""

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Stops the workers."""


class SerialExecutor:
    """Runs in this process."""

    def map(self, function: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
        """As `Executor.map`."""
        return map(function, items)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        return


class ProcessExecutor:
    """Runs in several processes of this machine.

    Args:
        jobs: Number of processes.
    """

    def __init__(self, jobs: int) -> None:
        self._jobs = jobs
        self._pool: ProcessPoolExecutor | None = None
        self._others: frozenset[BaseProcess] = frozenset()

    def map(self, function: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
        """As `Executor.map`; no more than two shards per process wait, so memory does not grow with the flight.

        Raises:
            ResourceError: A worker was killed.
        """
        if self._pool is None:
            # forkserver: a fork of this process would carry the locks of its threads along.
            context = multiprocessing.get_context("forkserver")
            self._others = frozenset(multiprocessing.active_children())
            self._pool = ProcessPoolExecutor(self._jobs, mp_context=context, initializer=_begin_worker)
        source = iter(items)
        waiting: deque[Future[Result]] = deque(
            self._pool.submit(function, item) for item in islice(source, 2 * self._jobs)
        )
        try:
            while waiting:
                result = waiting.popleft().result()
                waiting.extend(self._pool.submit(function, item) for item in islice(source, 1))
                yield result
        except BrokenProcessPool as error:
            raise ResourceError(
                "E-EXEC-01",
                "a worker process was killed",
                found=str(error),
                hint="most likely out of memory: use --jobs 1, or a smaller match.max_image_px",
            ) from error
        finally:
            for future in waiting:
                future.cancel()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._pool is None:
            return
        if kind is not None:
            # Nobody waits for the shards that are still being worked on.
            for worker in frozenset(multiprocessing.active_children()) - self._others:
                worker.terminate()
        self._pool.shutdown(cancel_futures=True)


def _begin_worker() -> None:
    limit_threads()
    # An interrupt goes to the whole process group; the parent alone decides what it means.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """Ends this worker when its parent is killed: it would wait for work for ever, or write beside the next run."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


class DaskExecutor:
    """Runs on a Dask cluster that sees the same folders.

    Args:
        address: Of the scheduler, "tcp://host:8786".

    Raises:
        MissingPartError: Dask is not installed.
        UsageError: The address is none.
        ResourceError: No scheduler answers there.
    """

    def __init__(self, address: str) -> None:
        try:
            distributed: Any = importlib.import_module("distributed")
        except ImportError as error:
            raise MissingPartError(
                "E-EXEC-02", "Dask is not installed", hint="pip install 'epitransfer[dask]'"
            ) from error
        try:
            self._client: Any = distributed.Client(address, timeout=10)
        except ValueError as error:
            raise UsageError(
                "E-EXEC-04",
                "--scheduler is no address",
                where=address,
                found=str(error),
                expected="tcp://host:8786",
                hint="check --scheduler",
            ) from error
        except (OSError, TimeoutError) as error:
            raise ResourceError(
                "E-EXEC-03", "no Dask scheduler answers", where=address, found=str(error), hint="check --scheduler"
            ) from error
        self._address = address
        self._lost = (distributed.KilledWorker, distributed.comm.CommClosedError, CancelledError)

    def map(self, function: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
        """As `Executor.map`.

        Raises:
            ResourceError: A worker or the scheduler was lost.
        """
        source = iter(items)
        ahead = 2 * max(1, sum(self._client.nthreads().values()))
        waiting: deque[Any] = deque(self._client.submit(function, item, pure=False) for item in islice(source, ahead))
        try:
            while waiting:
                result: Result = waiting.popleft().result()
                waiting.extend(self._client.submit(function, item, pure=False) for item in islice(source, 1))
                yield result
        except self._lost as error:
            raise ResourceError(
                "E-EXEC-05",
                "the Dask cluster lost a worker or its scheduler",
                where=self._address,
                found=f"{type(error).__name__}: {error}",
                hint="see the workers' memory; the same command carries on",
            ) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._client.close()


def executor_for(jobs: int, scheduler: str | None = None) -> Executor:
    """The executor that `--jobs` and `--scheduler` ask for."""
    if scheduler:
        return DaskExecutor(scheduler)
    return ProcessExecutor(jobs) if jobs > 1 else SerialExecutor()
