"""`Workers`: processes that each do one job at a time, and any of which may die, hang or throw.

Every worker has a pipe of its own. So a result always belongs to a known job, a dead worker is seen at once whatever
its exit code, and killing one can neither tear another's message nor leave a shared lock held. (Pools with shared
pipes cannot promise that: Pebble 5.2 notices a worker that leaves with exit code 0 only when its job times out.)
"""

from __future__ import annotations

import json
import multiprocessing
import os
import pickle
import signal
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from multiprocessing import connection
from typing import Any, NamedTuple, Protocol, Self

Work = Callable[[Any, int], Mapping[str, Any]]
"""What a worker does: (spec, seed) -> a row of plain data. A function of a module, so that it can be sent."""

SINGLE_THREADED = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"
)
"""Environment of a worker: the workers are the parallelism, and their sums must not depend on a thread count."""
START_SECONDS = 300.0
"""A worker that has not imported its work by then has failed to start [s]."""
START_FAILURES = 3
"""So many failed starts in a row are nobody's bad luck."""


class WorkersError(RuntimeError):
    """No worker can be started or reached; the message says why."""


class Job(NamedTuple):
    """``work(spec, seed)``, to be done."""

    key: Any
    """Comes back with the job's end; not None."""
    spec: Any
    seed: int


class Ended(NamedTuple):
    """How a job ended: with a result, or with the cause of its failure."""

    key: Any
    """The job's."""
    result: str | None
    """The row as JSON text; None if there is none."""
    cause: str
    """Why there is none, one line."""


class Pool(Protocol):
    """Workers to whom jobs are given one by one."""

    def idle(self) -> bool:
        """Whether there is room for a job."""
        ...

    def give(self, job: Job) -> None:
        """Hand over a job; only while there is room."""
        ...

    def wait(self) -> list[Ended]:
        """Sleep until something happens: jobs end (they are returned), or there may be room again.

        Raises:
            WorkersError: there is no hope of more.
        """
        ...


def finished(pool: Pool, waiting: deque[Job]) -> Iterator[Ended]:
    """Have a pool do the jobs that wait, and those that are appended meanwhile; how they end, as they end.

    Raises:
        WorkersError: of the pool.
    """
    busy = 0
    while waiting or busy:
        while waiting and pool.idle():
            pool.give(waiting.popleft())
            busy += 1
        for ended in pool.wait():
            busy -= 1
            yield ended


class Workers:
    """``n`` worker processes doing ``work``; a dead or hanging one is replaced. A context manager.

    Processes are spawned, not forked: a fork of a process with threads or an engine in it is not safe. What workers
    print goes to standard error. They ignore Ctrl-C (the owner decides) and end when the owner is killed.

    Args:
        work: the function; it and what it needs are imported once a worker.
        n: number of processes, at least 1.
        timeout: a job that takes longer is killed with its worker [s].
    """

    def __init__(self, work: Work, n: int, timeout: float) -> None:
        self._work = pickle.dumps(work)
        self._timeout = timeout
        self._start_failures = 0
        self._crew: list[_Worker] = []
        self._n = n

    def __enter__(self) -> Self:
        try:
            self._crew = [_Worker(self._work) for _ in range(self._n)]
        except BaseException:
            self._end(polite=False)
            raise
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        self._end(polite=kind is None)

    def idle(self) -> bool:
        """Whether a worker is free for a job."""
        return any(worker.ready and worker.key is None for worker in self._crew)

    def give(self, job: Job) -> None:
        """Hand a job to a free worker."""
        free = next(worker for worker in self._crew if worker.ready and worker.key is None)
        free.give(job.key, pickle.dumps((job.spec, job.seed)), self._timeout)

    def wait(self) -> list[Ended]:
        """Sleep until something happens: jobs end (they are returned), or a worker becomes free.

        Raises:
            WorkersError: workers fail to start, again and again.
        """
        patience = max(0.0, min(worker.deadline for worker in self._crew) - time.monotonic())
        sources = [source for worker in self._crew for source in (worker.pipe, worker.process.sentinel)]
        woken = set(connection.wait(sources, None if patience == float("inf") else patience))
        ended = []
        for i, worker in enumerate(self._crew):
            if worker.pipe in woken or worker.process.sentinel in woken or worker.deadline <= time.monotonic():
                end = self._attend(i, worker)
                if end is not None:
                    ended.append(end)
        return ended

    def _attend(self, i: int, worker: _Worker) -> Ended | None:
        """Take a worker's message; replace it if it is dead or late."""
        key, was_ready = worker.key, worker.ready
        message = worker.message()
        if message is not None:
            ok, text = message
            if not was_ready and not ok:
                raise WorkersError(f"workers cannot start: {text}")
            self._start_failures = 0
            worker.rest()
            if not was_ready:
                return None
            return Ended(key, text, "") if ok else Ended(key, None, text)
        if worker.process.is_alive() and not worker.broken and time.monotonic() < worker.deadline:
            return None  # woken for nothing
        late = worker.process.is_alive() and not worker.broken
        cause = worker.stop()
        if not was_ready:
            self._start_failures += 1
            if self._start_failures >= START_FAILURES:
                raise WorkersError(
                    f"workers die while starting ({'no answer' if late else cause}); a script of your own must start "
                    "its work below: if __name__ == '__main__':"
                )
        self._crew[i] = _Worker(self._work)
        if key is None:
            return None  # it had nothing to lose
        return Ended(key, None, f"hung: no end after {self._timeout:g} s, killed" if late else f"worker died: {cause}")

    def _end(self, polite: bool) -> None:
        for worker in self._crew:
            if polite and worker.key is None and worker.ready:
                worker.pipe.close()  # it reads the end of its pipe and leaves
        for worker in self._crew:
            worker.stop(seconds=5.0 if worker.pipe.closed else 0.0)
        self._crew = []


class _Worker:
    """One process, its pipe, and what it is at."""

    def __init__(self, work: bytes) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs, work), name="shepherd-phys worker", daemon=True)
        try:
            with birth():
                self.process.start()
        except OSError as error:
            raise WorkersError(f"workers cannot start: {error}") from error
        theirs.close()
        self.ready = False
        self.broken = False
        self.end = ""
        self.key: Any = None
        self.deadline = time.monotonic() + START_SECONDS

    def give(self, key: Any, job: bytes, timeout: float) -> None:
        self.key = key
        self.deadline = time.monotonic() + timeout
        try:
            self.pipe.send_bytes(job)
        except OSError:
            self.broken = True  # it died just now; wait() sees to it
            self.deadline = 0.0

    def rest(self) -> None:
        self.ready = True
        self.key = None
        self.deadline = float("inf")

    def message(self) -> tuple[bool, str] | None:
        """Its message if there is a whole one."""
        try:
            if self.pipe.poll():
                ok, text = self.pipe.recv()
                return bool(ok), str(text)
        except Exception:  # the end of the pipe, or a message torn by death
            self.broken = True
        return None

    def stop(self, seconds: float = 0.0) -> str:
        """End the process, by force unless it leaves within ``seconds``; how it ended."""
        if self.end:
            return self.end
        if self.broken:
            seconds = max(seconds, 1.0)  # it is dying by itself: let it say how
        self.process.join(seconds)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()
        self.pipe.close()
        code = self.process.exitcode
        self.process.close()
        self.end = f"exit code {code}"
        if code is not None and code < 0:
            names = {int(known): known.name for known in signal.Signals}
            self.end = f"killed by {names.get(-code, f'signal {-code}')}"
        return self.end


@contextmanager
def birth() -> Iterator[None]:
    """While a worker is born: the environment that it inherits, and no Ctrl-C for it."""
    before = {name: os.environ.get(name) for name in SINGLE_THREADED}
    os.environ.update(SINGLE_THREADED)
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT]) if hasattr(signal, "pthread_sigmask") else None
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
        if mask is not None:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def _serve(pipe: connection.Connection, pickled_work: bytes) -> None:
    """A worker's life: import the work, then do jobs until the pipe ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=end_with_owner, daemon=True).start()
    os.dup2(2, 1)  # standard output belongs to the owner, who may be writing JSON there
    try:
        work = pickle.loads(pickled_work)
    except BaseException as error:
        pipe.send((False, explain(error)))
        return
    pipe.send((True, ""))
    while True:
        try:
            job = pipe.recv_bytes()
        except EOFError:
            return
        pipe.send(attempt(work, job))


def end_with_owner() -> None:
    """Wait in a worker until its owner has died, then end it."""
    owner = multiprocessing.parent_process()
    if owner is not None:
        owner.join()
        os._exit(1)


def attempt(work: Work, job: bytes) -> tuple[bool, str]:
    """Do a pickled job (spec, seed): (True, row as JSON) or (False, cause).

    Rows cross as JSON, the very text that is kept: so a row is the same whoever made it, and one with a NaN or with
    something that is not plain data is an error of its episode.
    """
    try:
        spec, seed = pickle.loads(job)
        return True, json.dumps(dict(work(spec, seed)), allow_nan=False)
    except KeyboardInterrupt:  # only without processes: workers ignore Ctrl-C
        raise
    except BaseException as error:
        return False, explain(error)


def explain(error: BaseException) -> str:
    """An exception in one line, with the place that raised it."""
    frames = traceback.extract_tb(error.__traceback__)
    place = f" ({os.path.basename(frames[-1].filename)}:{frames[-1].lineno})" if frames else ""
    return f"{type(error).__name__}: {' '.join(str(error).split())}{place}"
