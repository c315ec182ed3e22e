"""Impacts of sheep and shepherds on thin walls and small pillars: does anything get through?"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from shepherd_phys.bodies import SHEEP, Body, Disc, built
from shepherd_phys.obstacles import MIN_THICKNESS, Pillar, Wall
from shepherd_phys.scenario import Scenario
from shepherd_phys.state import Floats, WorldState
from shepherd_phys.world import World

SHEPHERD = Disc()
PILLAR_RADIUS = 0.2
"""[m]"""
LANE = 40.0
"""Distance between neighbouring impacts, which must not meet [m]."""
HALF_WALL = 8.0
"""Half of a wall's length: more than a body slides along it in an impact [m]."""
STEPS = 12
"""Control steps of an impact: it arrives within 5, then pushes on."""
PAIRS = [(front, behind) for front in ("sheep", "shepherd") for behind in (None, "sheep", "shepherd")]
"""Who runs into the obstacle, and who pushes from behind."""


@dataclass
class _Charge:
    """A flock model for the experiment: every sheep is told a velocity."""

    wanted: Floats

    def velocities(self, state: WorldState, rng: np.random.Generator) -> Floats:
        return self.wanted


def impacts(count: int, seed: int, shepherd: Body = SHEPHERD, sheep: Body = SHEEP, **engine: int) -> dict[str, Any]:
    """Run ``count`` impacts at top speed and random angles, spread evenly over kinds, in worlds of many lanes.

    A body has tunnelled if at the end of any control step its centre lies inside the obstacle or on its far side.

    Args:
        count: number of impacts, rounded up to whole worlds.
        seed: of the angles and places.
        shepherd: every shepherd's body. Overlaps and touches are those of the disc that holds it.
        sheep: every sheep's body.
        engine: scenario fields to change (``substeps``, ``iterations``).

    Returns:
        impacts, how many touched the obstacle, how many tunnelled, the deepest overlap with an obstacle while
        pushed [m], and the seeds of the worlds where something got through.
    """
    lanes = [(pair, kind) for pair in PAIRS for kind in ("wall", "pillar")] * 10
    rng = np.random.default_rng(seed)
    radius = {"sheep": built(sheep, "sheep")[2], "shepherd": built(shepherd, "shepherd")[2]}
    speed = {"sheep": sheep.max_speed, "shepherd": shepherd.max_speed}
    centers = np.array([[0.0, LANE * k] for k in range(len(lanes))])
    obstacles = tuple(
        Wall((x, y - HALF_WALL), (x, y + HALF_WALL), MIN_THICKNESS) if kind == "wall" else Pillar((x, y), PILLAR_RADIUS)
        for (x, y), (_, kind) in zip(centers.tolist(), lanes, strict=True)
    )
    bodies = [(lane, role, who) for lane, (pair, _) in enumerate(lanes) for role, who in enumerate(pair) if who]
    order = [b for b in bodies if b[2] == "sheep"] + [b for b in bodies if b[2] == "shepherd"]
    n_sheep = sum(who == "sheep" for _, _, who in bodies)
    charge = _Charge(np.zeros((n_sheep, 2)))
    scenario = Scenario(
        n_sheep=n_sheep,
        n_flocks=1,
        shepherds=(shepherd,) * (len(order) - n_sheep),
        sheep=sheep,
        flock=charge,
        obstacles=obstacles,
    ).but(**engine)
    world = World(scenario)
    # the template only lends its shape; every position is set below
    blank = _blank(scenario)
    lane_of = np.array([lane for lane, _, _ in order])
    is_front = np.array([role == 0 for _, role, _ in order])
    is_wall = np.array([kind == "wall" for _, kind in lanes])[lane_of]
    half = np.where(is_wall, MIN_THICKNESS / 2, PILLAR_RADIUS)
    body_radius = np.array([radius[who] for _, _, who in order])

    done = touched = tunnelled = 0
    deepest = 0.0
    bad: list[int] = []
    while done < count:
        world_seed = int(rng.integers(2**32))
        draw = np.random.default_rng(world_seed)
        side = draw.choice([-1.0, 1.0], len(lanes))
        angle = draw.uniform(-1.4, 1.4, len(lanes))
        heading = np.stack([-side * np.cos(angle), np.sin(angle)], axis=1)
        aim = np.zeros((len(lanes), 2))  # where on the obstacle the impact is meant to be
        aim[:, 1] = np.where([kind == "wall" for _, kind in lanes], 0.0, draw.uniform(-0.1, 0.1, len(lanes)))
        gap = draw.uniform(0.0, 0.6, len(lanes))
        pos, wanted = np.empty((len(order), 2)), np.empty((len(order), 2))
        for i, (lane, role, who) in enumerate(order):
            front, behind = lanes[lane][0]
            clear = (PILLAR_RADIUS if lanes[lane][1] == "pillar" else MIN_THICKNESS / 2) + radius[front]
            back = clear / (math.cos(angle[lane]) if lanes[lane][1] == "wall" else 1.0) + gap[lane]
            if role == 1 and behind is not None:
                back += radius[front] + radius[behind] + 1e-3
            pos[i] = centers[lane] + aim[lane] - back * heading[lane]
            wanted[i] = heading[lane] * speed[who]
        charge.wanted[:] = wanted[:n_sheep]
        velocity = wanted.copy()  # they arrive at top speed from the first step on
        state = world.reset_to(
            blank.but(
                sheep_pos=pos[:n_sheep],
                sheep_vel=velocity[:n_sheep],
                shepherd_pos=pos[n_sheep:],
                shepherd_vel=velocity[n_sheep:],
                shepherd_angle=np.arctan2(wanted[n_sheep:, 1], wanted[n_sheep:, 0]),
            ),
            world_seed,
        )
        action = wanted[n_sheep:] / speed["shepherd"]
        hit, through = np.zeros(len(order), dtype=bool), np.zeros(len(order), dtype=bool)
        previous = pos - centers[lane_of]
        for _ in range(STEPS):
            state = world.step(action)
            now = np.concatenate([state.sheep_pos, state.shepherd_pos]) - centers[lane_of]
            away = np.where(is_wall, np.abs(now[:, 0]), np.hypot(now[:, 0], now[:, 1]))
            # far side: of a wall by the sign of x; of a pillar where one step leads to the opposite of where it was
            crossed = np.where(is_wall, np.sign(now[:, 0]) != side[lane_of], (now * previous).sum(axis=1) < 0.0)
            near = away < half + body_radius + 1e-2
            hit |= near
            through |= (away < half) | (crossed & (np.abs(now[:, 1]) < HALF_WALL) & (np.abs(previous[:, 0]) < 2.0))
            deepest = max(deepest, float((half + body_radius - away)[near].max(initial=0.0)))
            previous = now
        done += len(lanes)
        touched += len(np.unique(lane_of[hit & is_front]))
        lost = len(np.unique(lane_of[through]))
        tunnelled += lost
        if lost:
            bad.append(world_seed)
    return {
        "impacts": done,
        "touched": touched,
        "tunnelled": tunnelled,
        "deepest_overlap_m": deepest,
        "bad_world_seeds": bad[:10],
    }


def _blank(scenario: Scenario) -> WorldState:
    """A state of the scenario's size with nobody moving; made without placing anybody."""
    n, p = scenario.n_sheep, scenario.n_shepherds
    return WorldState(
        step=0,
        time=0.0,
        goal_pos=np.array([-1e4, 0.0]),
        goal_radius=scenario.goal_radius,
        sheep_pos=np.zeros((n, 2)),
        sheep_vel=np.zeros((n, 2)),
        sheep_heading=np.tile([1.0, 0.0], (n, 1)),
        sheep_goal_distance=np.zeros(n),
        sheep_in_goal=np.zeros(n, dtype=np.bool_),
        sheep_arrived=np.zeros(n, dtype=np.bool_),
        sheep_radius=np.zeros(n),
        sheep_max_speed=np.zeros(n),
        shepherd_pos=np.zeros((p, 2)),
        shepherd_vel=np.zeros((p, 2)),
        shepherd_angle=np.zeros(p),
        shepherd_radius=np.zeros(p),
        shepherd_max_speed=np.zeros(p),
        shepherd_path=np.zeros(p),
        collisions=0,
        obstacles=scenario.obstacles,
        control_dt=scenario.control_dt,
    )
