"""Impacts of sheep and shepherds on thin walls and small obstacles of every kind: does anything get through?"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pymunk

from shepherd_phys.bodies import SHEEP, Body, Disc, built
from shepherd_phys.geometry import surfaces
from shepherd_phys.obstacles import MIN_THICKNESS, Box, Fence, Obstacle, Pillar, Polygon, Wall, outline
from shepherd_phys.outlines import edge
from shepherd_phys.scenario import Scenario
from shepherd_phys.state import Floats, WorldState
from shepherd_phys.world import World

LANE = 40.0
"""Distance between neighbouring impacts, which must not meet [m]."""
HALF_WALL = 8.0
"""Half of a wall's length: more than a body slides along it in an impact [m]."""
RUN_UP = 6.0
"""Where bodies are put before they are moved on until they nearly touch [m]."""
STEPS = 12
"""Control steps of an impact: it arrives within 5, then pushes on."""
REST = 5
"""Control steps after that in which nobody wants to move."""
REPEATS = 4
"""Lanes of each sort in a world."""
PAIRS = [(front, behind) for front in ("sheep", "shepherd") for behind in (None, "sheep", "shepherd")]
"""Who runs into the obstacle, and who pushes from behind."""
KINDS: dict[str, Callable[[float], Obstacle]] = {
    "Wall": lambda y: Wall((0.0, y - HALF_WALL), (0.0, y + HALF_WALL), MIN_THICKNESS),
    "Pillar": lambda y: Pillar((0.0, y), 0.2),
    "Box": lambda y: Box((0.0, y), (MIN_THICKNESS, 1.0), 0.3),
    "Polygon": lambda y: Polygon(((-0.15, y - 0.4), (0.15, y - 0.3), (0.05, y + 0.4))),
    "Fence": lambda y: Fence((0.0, y - HALF_WALL), (0.0, y + HALF_WALL), gap=0.04, thickness=MIN_THICKNESS),
}
"""Obstacles by kind, as thin as they may be, across the lane at a height y; the fence's gap is too narrow for all."""
ACROSS = ("Wall", "Fence")
"""Kinds that nobody gets round."""


@dataclass
class _Charge:
    """A flock model for the experiment: every sheep is told a velocity."""

    wanted: Floats

    def velocities(self, state: WorldState, rng: np.random.Generator) -> Floats:
        return self.wanted


def impacts(count: int, seed: int, shepherd: Body | None = None, sheep: Body = SHEEP, **engine: int) -> dict[str, Any]:
    """Run ``count`` impacts at top speed and random angles, spread evenly over kinds, in worlds of many lanes.

    A body has tunnelled if at the end of any control step its centre lies inside the obstacle or on its far side, or if
    its straight way in that step leads through the obstacle and the way round is longer than the fastest body can walk
    in a step: whoever slides round a corner cuts it off.

    Args:
        count: number of impacts, rounded up to whole worlds.
        seed: of the angles and places.
        shepherd: every shepherd's body; none given: the default disc. It starts with its nose towards the obstacle.
            Overlaps and touches are those of the disc that holds it.
        sheep: every sheep's body.
        engine: scenario fields to change (``substeps``, ``iterations``).

    Returns:
        impacts, how many touched the obstacle, how many tunnelled, in all and by kind, the deepest overlap with an
        obstacle while pushed and when all have come to rest [m], and the seeds of worlds where something got through.
    """
    lanes = [(pair, kind) for pair in PAIRS for kind in KINDS] * REPEATS
    rng = np.random.default_rng(seed)
    bodies: dict[str, Body] = {"sheep": sheep, "shepherd": shepherd or Disc()}
    reach = {who: built(body, who)[2] for who, body in bodies.items()}
    roles = [(lane, role, who) for lane, (pair, _) in enumerate(lanes) for role, who in enumerate(pair) if who]
    order = [r for r in roles if r[2] == "sheep"] + [r for r in roles if r[2] == "shepherd"]
    n_sheep = sum(who == "sheep" for _, _, who in roles)
    charge = _Charge(np.zeros((n_sheep, 2)))
    scenario = Scenario(
        n_sheep=n_sheep,
        n_flocks=1,
        shepherds=(bodies["shepherd"],) * (len(order) - n_sheep),
        sheep=sheep,
        flock=charge,
        obstacles=tuple(KINDS[kind](LANE * lane) for lane, (_, kind) in enumerate(lanes)),
    ).but(**engine)
    world = World(scenario)
    blank = _blank(scenario)  # it only lends its shape; every position is set below
    lane_of = np.array([lane for lane, _, _ in order])
    radius = np.array([reach[who] for _, _, who in order])
    speed = np.array([bodies[who].max_speed for _, _, who in order])
    is_front = np.array([role == 0 for _, role, _ in order])
    front_of = np.array([int(np.flatnonzero(is_front & (lane_of == lane))[0]) for lane in lane_of])
    across = np.isin([kind for _, kind in lanes], ACROSS)[lane_of]
    gap_to = _Gap(scenario.obstacles, lane_of)
    stride = float(speed.max()) * scenario.control_dt

    done = touched = 0
    pushed = rested = 0.0
    lost = dict.fromkeys(KINDS, 0)
    bad: list[int] = []
    while done < count:
        world_seed = int(rng.integers(2**32))
        draw = np.random.default_rng(world_seed)
        side = draw.choice([-1.0, 1.0], len(lanes))[lane_of]
        angle = draw.uniform(-1.4, 1.4, len(lanes))[lane_of]
        aim = draw.uniform(-0.1, 0.1, len(lanes))[lane_of]
        room = draw.uniform(0.0, 0.6, len(lanes))[lane_of]
        heading = np.stack([-side * np.cos(angle), np.sin(angle)], axis=1)
        pos = np.stack([np.zeros(len(order)), LANE * lane_of + aim], axis=1) - RUN_UP * heading
        for _ in range(60):  # those in front go on until they nearly touch; the others follow close behind
            pos += np.maximum(gap_to(pos) - radius - room - 1e-6, 0.0)[:, None] * heading
        pos = np.where(is_front[:, None], pos, pos[front_of] - (radius[front_of] + radius + 1e-3)[:, None] * heading)
        wanted = heading * speed[:, None]
        charge.wanted[:] = wanted[:n_sheep]
        state = world.reset_to(
            blank.but(
                sheep_pos=pos[:n_sheep],
                sheep_vel=wanted[:n_sheep],  # they arrive at top speed from the first step on
                shepherd_pos=pos[n_sheep:],
                shepherd_vel=wanted[n_sheep:],
                shepherd_angle=np.arctan2(heading[n_sheep:, 1], heading[n_sheep:, 0]),
            ),
            world_seed,
        )
        hit, through = np.zeros(len(order), dtype=bool), np.zeros(len(order), dtype=bool)
        for step in range(STEPS + REST):
            if step == STEPS:
                charge.wanted[:] = 0.0
            state = world.step(heading[n_sheep:] if step < STEPS else np.zeros((len(order) - n_sheep, 2)))
            now = np.concatenate([state.sheep_pos, state.shepherd_pos])
            gap = gap_to(now)
            hit |= gap < radius + 1e-2
            beyond = across & (np.sign(now[:, 0]) != side) & (np.abs(now[:, 1] - LANE * lane_of) < HALF_WALL)
            through |= (gap < 0.0) | beyond | gap_to.crossed(pos, now, gap < 1.0, stride)
            pushed = max(pushed, _overlap(world.space)) if step < STEPS else pushed
            pos = now
        rested = max(rested, _overlap(world.space))
        done += len(lanes)
        touched += len(np.unique(lane_of[hit & is_front]))
        for lane in np.unique(lane_of[through]).tolist():
            lost[lanes[lane][1]] += 1
        if through.any():
            bad.append(world_seed)
    return {
        "impacts": done,
        "touched": touched,
        "tunnelled": sum(lost.values()),
        "tunnelled_by_kind": lost,
        "deepest_overlap_m": pushed,
        "deepest_overlap_at_rest_m": rested,
        "bad_world_seeds": bad[:10],
    }


class _Gap:
    """Distances of bodies from the obstacle of their own lane."""

    def __init__(self, obstacles: tuple[Obstacle, ...], lane_of: Any) -> None:
        self._geometry = surfaces(obstacles)
        ground = pymunk.Body(body_type=pymunk.Body.STATIC)
        shapes = [obstacle.shapes(ground) for obstacle in obstacles]
        self._own = np.repeat(np.arange(len(shapes)), [len(own) for own in shapes])[None] == lane_of[:, None]
        self._shapes = [shapes[lane] for lane in lane_of]
        for own in shapes:
            for shape in own:
                shape.cache_bb()

    def __call__(self, pos: Floats) -> Floats:
        """From centres (M, 2) to the surface (M,) [m]."""
        return np.asarray(np.where(self._own, self._geometry.static_distances(pos)[0], math.inf).min(axis=1))

    def crossed(self, before: Floats, now: Floats, which: Any, stride: float) -> Any:
        """Of those asked about, who went through: the straight way leads through, the way round is over ``stride``."""
        crossed = np.zeros(len(now), dtype=bool)
        for i in which.nonzero()[0]:
            start, end = tuple(before[i].tolist()), tuple(now[i].tolist())
            crossed[i] = any(
                shape.segment_query(start, end) is not None and _way_round(shape, before[i], now[i]) > stride
                for shape in self._shapes[i]
            )
        return crossed


def _way_round(shape: pymunk.Shape, start: Floats, end: Floats) -> float:
    """The shortest way from start to end (2,) round a convex shape that lies between them [m]."""
    drawn = outline(shape)
    assert drawn is not None  # the kinds above are all of discs, segments and polygons
    hull = edge(drawn, 32, start, end)
    first, last = sorted(int(np.hypot(*(hull - place).T).argmin()) for place in (start, end))
    sides = np.hypot(*(np.roll(hull, -1, axis=0) - hull).T)
    one = float(sides[first:last].sum())
    return min(one, float(sides.sum()) - one)


def _overlap(space: pymunk.Space) -> float:
    """How deep a moving body is in an obstacle at most [m]."""
    deepest = 0.0
    for body in space.bodies:
        for shape in body.shapes:
            for hit in space.shape_query(shape):
                if hit.shape is not None and hit.shape.body is space.static_body:
                    deepest = max(deepest, *(-point.distance for point in hit.contact_point_set.points))
    return deepest


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
