"""The worlds of a `shepherd_phys.envs.team.TeamVecEnv` at work: in this process, or spread over worker processes.

Observations, actions and rewards lie in memory that all processes share; what else there is to say goes through pipes.
"""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import pickle
import signal
import threading
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from multiprocessing import connection
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shepherd_phys.settings import SettingsError
from shepherd_phys.workers import birth, end_with_owner, explain

from ._team_world import Ending, Plan, TeamWorld

WORLD_COST = 7.0
"""What a control step of a world costs apart from its shepherds, each of whom costs 1 (measured, roughly)."""

Answer = dict[int, Any]
"""World index -> what it said; only those that said something."""


class WorkerError(RuntimeError):
    """A worker threw or died; the message says which and why. The vector env is closed then."""


class Memory:
    """The arrays of all slots, by name: the parts of the observation, "actions", "rewards"; and "steps" of all worlds.

    Anonymous memory that is handed to the workers when they are born: whoever dies, there is nothing to clean up.
    """

    def __init__(self, shapes: Mapping[str, tuple[int, ...]], raw: Any = None) -> None:
        self.shapes = dict(shapes)
        sizes = [int(np.prod(shape)) for shape in self.shapes.values()]
        self.raw = raw if raw is not None else multiprocessing.get_context("spawn").RawArray(ctypes.c_float, sum(sizes))
        numbers = np.frombuffer(memoryview(self.raw), np.float32)
        parts = np.split(numbers, np.cumsum(sizes)[:-1])
        self.arrays: dict[str, NDArray[np.float32]] = {
            name: part.reshape(shape) for (name, shape), part in zip(self.shapes.items(), parts, strict=True)
        }


class Local:
    """Some worlds in this process."""

    def __init__(self, plan: Plan, team_sizes: Sequence[int], mine: Iterable[int], memory: Memory) -> None:
        first = np.concatenate([[0], np.cumsum(team_sizes)]).tolist()
        self._actions: dict[int, NDArray[np.float32]] = {}
        self._steps = memory.arrays["steps"]
        self.worlds: dict[int, TeamWorld] = {}
        for index in mine:
            slots = slice(first[index], first[index + 1])
            parts = {name: memory.arrays[name][slots] for name in plan.shapes()}
            self.worlds[index] = TeamWorld(plan, index, team_sizes[index], parts, memory.arrays["rewards"][slots])
            self._actions[index] = memory.arrays["actions"][slots]

    def do(self, order: str, *details: Any) -> Answer:
        """Carry out an order: "restart" (root, number), "decide" (); or for some worlds "get", "set" or "call"."""
        if order in {"restart", "decide"}:
            endings: dict[int, Ending] = {}
            for index, world in self.worlds.items():
                try:
                    if order == "restart":
                        world.restart(*details)
                        continue
                    ending = world.decide(self._actions[index])
                except Exception as error:
                    error.add_note(f"in world {index}, episode seed {world.seed}")
                    raise
                self._steps[index] = world.decision_steps
                if ending is not None:
                    endings[index] = ending
            return endings
        indices, name, *values = details
        mine = [index for index in indices if index in self.worlds]
        if order == "get":
            return {index: getattr(self.worlds[index], name) for index in mine}
        if order == "set":
            for index in mine:
                setattr(self.worlds[index], name, values[0])
            return {}
        args, named = values
        return {index: getattr(self.worlds[index], name)(*args, **named) for index in mine}

    def give(self, order: str, *details: Any) -> None:
        """Take an order, to be carried out when its answer is asked for."""
        self._order = (order, *details)

    def answer(self) -> Answer:
        """Carry out the order that was given."""
        return self.do(*self._order)

    def close(self) -> None:
        """Nothing to end."""


class Crew:
    """The same worlds in ``n`` worker processes, the work spread evenly.

    Processes are spawned. What they print goes to standard error; they ignore Ctrl-C, which is the owner's, and end
    with their owner.

    Raises:
        SettingsError: the plan cannot be pickled.
        WorkerError: a worker does not start.
    """

    def __init__(self, plan: Plan, team_sizes: Sequence[int], n: int, memory: Memory) -> None:
        try:
            pickled = pickle.dumps((plan, tuple(team_sizes)))
        except Exception as error:
            raise SettingsError(
                f"scenario, rewards: cannot be sent to workers ({error}); use functions and classes of a module, or "
                "n_workers=0, which sends nothing"
            ) from None
        context = multiprocessing.get_context("spawn")
        self._workers: list[_Worker] = []
        self._answer: Answer = {}
        try:
            for mine in shared_out(team_sizes, n):
                self._workers.append(_Worker(context, len(self._workers), mine, pickled, memory))
            self.answer()  # each says that it is ready
        except BaseException:
            self.close()
            raise

    def do(self, order: str, *details: Any) -> Answer:
        """As `Local.do`; what the worlds' own attributes and methods raise is raised here."""
        self.give(order, *details)
        return self.answer()

    def give(self, order: str, *details: Any) -> None:
        """Hand the order to all workers; what an earlier, interrupted one still has to answer is forgotten."""
        self._wait()
        if not self._workers:
            raise WorkerError("the vector env is closed")
        message = pickle.dumps((order, *details))
        for worker in self._workers:
            worker.send(message)

    def answer(self) -> Answer:
        """Wait until all workers have carried out the order. After Ctrl-C, asking again continues the wait."""
        answer, refusal = self._wait()
        if refusal is not None:
            raise refusal
        return answer

    def _wait(self) -> tuple[Answer, BaseException | None]:
        """Wait until no worker is busy: what the worlds said, and what one of them raised on a user's order."""
        refusal: BaseException | None = None
        try:
            while waiting := [worker for worker in self._workers if worker.busy]:
                connection.wait([source for worker in waiting for source in (worker.pipe, worker.process.sentinel)])
                for worker in waiting:
                    if worker.pipe.poll() or not worker.process.is_alive():
                        reply = worker.receive()
                        if isinstance(reply, BaseException):
                            refusal = reply
                        else:
                            self._answer.update(reply)
        except WorkerError:
            self.close()
            raise
        answer, self._answer = self._answer, {}
        return answer, refusal

    def close(self) -> None:
        """End the workers; those in the middle of something are killed."""
        for worker in self._workers:
            worker.pipe.close()  # it reads the end of its pipe and leaves
        for worker in self._workers:
            worker.end(seconds=0.0 if worker.busy else 5.0)
        self._workers = []


def shared_out(team_sizes: Sequence[int], n: int) -> list[list[int]]:
    """Indices of the worlds for each of n workers (fewer where there are fewer worlds), about evenly by cost."""
    shares: list[list[int]] = [[] for _ in range(min(n, len(team_sizes)))]
    load = [0.0] * len(shares)
    for index in sorted(range(len(team_sizes)), key=lambda i: (-team_sizes[i], i)):
        least = load.index(min(load))
        shares[least].append(index)
        load[least] += WORLD_COST + team_sizes[index]
    return [sorted(share) for share in shares]


class _Worker:
    """One process and its pipe, seen from the owner."""

    def __init__(self, context: Any, number: int, mine: list[int], pickled: bytes, memory: Memory) -> None:
        self.name = f"worker {number}"
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(
            target=_serve,
            args=(theirs, mine, pickled, memory.shapes, memory.raw),
            name=f"shepherd-phys team {number}",
            daemon=True,
        )
        self.busy = True  # starting
        self._ready = self._torn = False
        try:
            with birth():
                self.process.start()
        except OSError as error:
            raise WorkerError(f"{self.name}: cannot start ({error})") from error
        theirs.close()

    def send(self, message: bytes) -> None:
        self.busy = True
        with suppress(OSError):  # it has died: the wait for its answer finds out
            self.pipe.send_bytes(message)

    def receive(self) -> Any:
        """Its answer, or the exception that an order of a user's raised.

        Raises:
            WorkerError: it has thrown or died.
        """
        if self._torn:
            raise WorkerError(f"{self.name}: interrupted in the middle of its answer; the vector env is closed")
        self._torn = True  # until it is whole: Ctrl-C may strike in between
        try:
            kind, content = pickle.loads(self.pipe.recv_bytes())
        except (EOFError, OSError):
            raise WorkerError(f"{self.name} died: {self._cause()}") from None
        self._torn = False
        self.busy = False
        self._ready = True
        if kind == "failed":
            raise WorkerError(f"{self.name}: {content}")
        return content

    def _cause(self) -> str:
        self.process.join(5.0)
        code = self.process.exitcode
        if code is not None and code < 0:
            names = {int(known): known.name for known in signal.Signals}
            return f"killed by {names.get(-code, f'signal {-code}')}"
        if not self._ready:
            return f"exit code {code} while starting; a script must start its work below: if __name__ == '__main__':"
        return f"exit code {code}"

    def end(self, seconds: float) -> None:
        self.process.join(seconds)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()
        self.process.close()


def _serve(
    pipe: connection.Connection, mine: list[int], pickled: bytes, shapes: Mapping[str, tuple[int, ...]], raw: Any
) -> None:
    """A worker's life: build its worlds, then carry out orders until the pipe ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=end_with_owner, daemon=True).start()
    os.dup2(2, 1)  # standard output belongs to the owner, who may be writing JSON there
    try:
        plan, team_sizes = pickle.loads(pickled)
        worlds = Local(plan, team_sizes, mine, Memory(shapes, raw))
    except BaseException as error:
        pipe.send(("failed", explain(error)))
        return
    pipe.send(("done", {}))
    while True:
        try:
            order, *details = pickle.loads(pipe.recv_bytes())
        except (EOFError, OSError):
            return
        try:
            reply = pickle.dumps(("done", worlds.do(order, *details)))
        except BaseException as error:
            if order in {"get", "set", "call"}:
                reply = _refusal(error)
            else:
                notes = getattr(error, "__notes__", [])
                reply = pickle.dumps(("failed", ", ".join([explain(error), *notes])))
        try:
            pipe.send_bytes(reply)
        except OSError:
            return  # the owner has closed


def _refusal(error: BaseException) -> bytes:
    """The exception itself, or what it says where it cannot be sent."""
    try:
        reply = pickle.dumps(("done", error))
        pickle.loads(reply)
    except Exception:
        return pickle.dumps(("done", RuntimeError(explain(error))))
    return reply
