"""What obstacles cost: the time outside the engine's steps with them over the same without, side by side."""

from __future__ import annotations

import time

import numpy as np

from shepherd_phys.controllers.strombom import StrombomSettings, StrombomTeam
from shepherd_phys.envs import ShepherdingEnv
from shepherd_phys.layouts import Kind, Scattered
from shepherd_phys.scenario import Scenario
from shepherd_phys.state import WorldState
from shepherd_phys.world import World

KINDS: tuple[Kind, ...] = ("Pillar", "Wall", "Box", "Polygon")
"""Of the obstacles, each as often as the others."""


class _Run:
    """One scenario's env, and a twin world whose engine steps are timed one by one."""

    def __init__(self, scenario: Scenario) -> None:
        self.env = ShepherdingEnv(scenario, rewards="wild")
        self.twin = World(scenario)
        self.team = StrombomTeam(StrombomSettings())
        self.whole = self.engine = 0.0
        self.counted = 0

    def reset(self, seed: int) -> None:
        self.env.reset(seed=seed)
        self.twin.reset(seed)
        self.team.reset(self.env.user_rng)
        step = self.twin.space.step

        def timed(dt: float) -> None:
            start = time.thread_time()
            step(dt)
            self.spent += time.thread_time() - start

        self.twin.space.step = timed  # type: ignore[method-assign]

    def advance(self) -> None:
        """One control step of both, counted while at least half of the sheep are threatened."""
        action = self.team.act(np.empty(0, dtype=np.float32), self.env.state)
        start = time.thread_time()
        self.env.step(action)
        seconds = time.thread_time() - start
        self.spent = 0.0
        self.twin.step(action)
        if _threatened(self.env.state, self.env.scenario) >= 0.5:
            self.whole, self.engine, self.counted = self.whole + seconds, self.engine + self.spent, self.counted + 1


def _threatened(state: WorldState, scenario: Scenario) -> float:
    apart = np.linalg.norm(state.sheep_pos[:, None] - state.shepherd_pos[None], axis=2)
    return float((apart.min(axis=1) <= scenario.flock.detection_radius).mean())


def obstacle_cost(count: int, n_steps: int, seed: int) -> dict[str, float]:
    """One run: the environment's steps while a flock of 100 sheep is driven, with obstacles and without, in turn.

    Times are of the processor, in which other work on the machine counts little. The episodes begin alike. With
    obstacles an observation has a fourth channel, all others are cut, sheep feel what is near, and a control step has
    three engine steps instead of two.

    Args:
        count: obstacles, of all kinds.
        n_steps: control steps to count in each.
        seed: of the first episode.

    Returns:
        ``ratio`` of the times outside the engine, and microseconds a control step: ``outside_open_us``,
        ``outside_us``, ``engine_open_us``, ``engine_us``.
    """
    open_world = Scenario(n_flocks=1)
    runs = [_Run(open_world), _Run(open_world.but(layout=Scattered(count=count, kinds=KINDS)))]
    while min(run.counted for run in runs) < n_steps:
        for run in runs:
            run.reset(seed)
        seed += 1
        for _ in range(open_world.n_steps):
            for run in runs:
                run.advance()
            if min(run.counted for run in runs) >= n_steps:
                break
    (without, engine_open), (outside, engine) = (
        ((run.whole - run.engine) / run.counted * 1e6, run.engine / run.counted * 1e6) for run in runs
    )
    return {
        "ratio": outside / without,
        "outside_open_us": without,
        "outside_us": outside,
        "engine_open_us": engine_open,
        "engine_us": engine,
    }
