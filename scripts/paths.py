"""Where everybody walks: the paths of an episode, and how long each place is stood on over many."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from shepherd_phys import __version__, campaign
from shepherd_phys.campaign import CampaignError, Ledger, Task
from shepherd_phys.controllers import Controller
from shepherd_phys.controllers.evaluation import run_episode
from shepherd_phys.envs.shepherding import ShepherdingEnv
from shepherd_phys.state import Floats, WorldState

from .points import Point, find_controller

REACH = 30.0
"""A map shows places so near to the goal's centre, along each axis [m]."""
CELL = 0.75
"""Side of a map's cell [m]."""
CELLS = round(2 * REACH / CELL)
"""Of a map, along each axis."""

Who = Literal["shepherds", "sheep"]
Frame = Literal["flock", "world"]


@dataclass(frozen=True)
class Walks:
    """The paths of an episode: T control steps, N sheep, P shepherds."""

    start: WorldState
    sheep: Floats
    """(T + 1, N, 2) [m]."""
    shepherds: Floats
    """(T + 1, P, 2) [m]."""
    row: dict[str, Any]
    """What `run_episode` measured."""


class _Watched:
    """A controller beside which the states are kept that it is handed."""

    def __init__(self, controller: Controller) -> None:
        self._controller = controller
        self.lidar = controller.lidar
        self.states: list[WorldState] = []

    def reset(self, rng: np.random.Generator) -> None:
        self._controller.reset(rng)

    def act(self, observation: Any, state: WorldState) -> NDArray[np.float64]:
        self.states.append(state)
        return self._controller.act(observation, state)


def walks(point: Point, seed: int) -> Walks:
    """Run an episode of a point and keep its paths."""
    watched = _Watched(find_controller(point.controller))
    env = ShepherdingEnv(point.scenario, rewards={}, lidar=watched.lidar)
    row = run_episode(watched, env, seed)
    states = [*watched.states, env.state]
    env.close()
    sheep, shepherds = (np.stack([getattr(state, name) for state in states]) for name in ("sheep_pos", "shepherd_pos"))
    return Walks(states[0], sheep, shepherds, row)


def turned(places: Floats, start: WorldState, frame: Frame) -> Floats:
    """Places (.., 2) [m] as seen from the goal's centre; in the frame of the flock its centroid starts straight up."""
    seen = places - start.goal_pos
    x, y = start.sheep_pos.mean(axis=0) - start.goal_pos
    length = float(np.hypot(x, y))
    if frame == "world" or length == 0.0:
        return np.asarray(seen)
    return np.asarray(seen @ (np.array([[y, x], [-x, y]]) / length))


class Mapped(NamedTuple):
    """What a map is of."""

    point: Point
    who: Who
    frame: Frame


def stood(mapped: Mapped, seed: int) -> dict[str, Any]:
    """Control steps for which somebody stands in each cell, in one episode: the work of a campaign.

    Returns:
        ``cells`` and ``counts``, of those that anybody entered; ``n``, how many walked; ``dt`` [s]; ``in_goal_end``.
    """
    walk = walks(mapped.point, seed)
    paths = walk.sheep if mapped.who == "sheep" else walk.shepherds
    seen = turned(paths[1:], walk.start, mapped.frame).reshape(-1, 2)
    index = np.floor((seen + REACH) / CELL).astype(np.int64)
    inside = index[((index >= 0) & (index < CELLS)).all(axis=1)]
    cells, counts = np.unique(inside @ (1, CELLS), return_counts=True)
    return {
        "cells": cells.tolist(),
        "counts": counts.tolist(),
        "n": paths.shape[1],
        "dt": walk.start.control_dt,
        "in_goal_end": walk.row["in_goal_end"],
    }


class Map(NamedTuple):
    """How long a place is stood on."""

    controller: str
    seconds: Floats
    """(CELLS, CELLS), row y, column x: seconds per m², mean over episodes and over those who walk."""
    trials: int
    in_goal_end: float
    """Mean over episodes [%]."""


def maps(
    points: Sequence[Point],
    seeds: Sequence[int],
    who: Who,
    frame: Frame,
    *,
    workers: int,
    report: Callable[[campaign.Progress], None] | None = None,
) -> list[Map]:
    """Run the episodes of every point on all seeds, and map them.

    Raises:
        CampaignError: an episode has no result.
    """
    todo = [
        Task(point.settings_hash(), seed, Mapped(point, who, frame), str(point)) for point in points for seed in seeds
    ]
    with tempfile.TemporaryDirectory() as folder, Ledger(Path(folder), __version__) as ledger:
        outcome = campaign.run(todo, stood, workers=workers, ledger=ledger, report=report)
    for failure in outcome.failures:
        raise CampaignError(str(failure))
    rows = {task.key: row for task, row in zip(todo, outcome.rows, strict=True) if row is not None}
    of = partial(_map, seeds=seeds, rows=rows)
    return [of(point) for point in points]


def _map(point: Point, seeds: Sequence[int], rows: dict[tuple[str, int], dict[str, Any]]) -> Map:
    name = point.settings_hash()
    own = [rows[name, seed] for seed in seeds]
    seconds = np.zeros(CELLS * CELLS)
    for row in own:
        share = row["dt"] / (CELL**2 * max(1, row["n"]) * len(own))
        seconds[row["cells"]] += np.asarray(row["counts"], dtype=np.float64) * share
    delivered = sum(row["in_goal_end"] for row in own) / len(own)
    return Map(point.controller, seconds.reshape(CELLS, CELLS), len(own), delivered)
