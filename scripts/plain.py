"""The same control step written plainly: what a user of pymunk and numpy would write first.

It is the yardstick of ``speedup_over_plain_pymunk`` and an independent check of the fast world: numpy flock, the public
``segment_query_first`` for every beam, body properties one by one; the same substeps, iterations and random draws.
Discs only, no obstacles; the default lidar and the ``wild`` rewards.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pymunk
from numpy.typing import NDArray

from shepherd_phys.flock import Strombom
from shepherd_phys.lidar import Lidar
from shepherd_phys.scenario import Scenario
from shepherd_phys.state import Floats, WorldState

WILD, TAME, SHEPHERD = 1, 2, 4
"""Collision categories: sheep that have never been in the goal, the others, shepherds."""


@dataclass
class PlainStep:
    """What one plain control step gives."""

    sheep_pos: Floats
    sheep_vel: Floats
    shepherd_pos: Floats
    observation: NDArray[np.float32]
    reward: float


class PlainWorld:
    """The paper's world, started from a given state.

    Args:
        scenario: discs only, no obstacles, the Strombom flock.
        state: where everything is.
        rng: the sheep's random draws.
    """

    def __init__(self, scenario: Scenario, state: WorldState, rng: np.random.Generator) -> None:
        self.scenario, self.rng, self.lidar = scenario, rng, Lidar()
        self.goal, self.heading, self.arrived = state.goal_pos, state.sheep_heading.copy(), state.sheep_arrived.copy()
        self.space = pymunk.Space()
        self.space.iterations = scenario.iterations
        self.space.collision_slop = scenario.collision_slop
        self.sheep = [
            self._disc(scenario.sheep, p, v, 0) for p, v in zip(state.sheep_pos, state.sheep_vel, strict=True)
        ]
        self.shepherds = [
            self._disc(body, p, v, k + 1)
            for k, (body, p, v) in enumerate(
                zip(scenario.shepherds, state.shepherd_pos, state.shepherd_vel, strict=True)
            )
        ]
        for body, arrived in zip(self.sheep, self.arrived, strict=True):
            self._mark(body, TAME if arrived else WILD, 0)
        for k, body in enumerate(self.shepherds):
            self._mark(body, SHEPHERD, k + 1)
        angle = 2 * np.pi * np.arange(self.lidar.beams) / self.lidar.beams
        self.beams = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        first = self._frame()[0]
        self.frames = [first, first, first]

    def _disc(self, settings: object, pos: Floats, vel: Floats, group: int) -> pymunk.Body:
        mass, radius = settings.mass, settings.radius  # type: ignore[attr-defined]
        body = pymunk.Body(mass, math.inf)
        body.position, body.velocity = (float(pos[0]), float(pos[1])), (float(vel[0]), float(vel[1]))
        shape = pymunk.Circle(body, radius)
        shape.friction = 0.0
        self.space.add(body, shape)
        return body

    @staticmethod
    def _mark(body: pymunk.Body, category: int, group: int) -> None:
        (shape,) = body.shapes
        shape.filter = pymunk.ShapeFilter(group=group, categories=category)

    def step(self, action: Floats) -> PlainStep:
        """One control step.

        Args:
            action: (P, 2) wanted velocities over top speed.
        """
        scenario = self.scenario
        pos = np.array([tuple(b.position) for b in self.sheep])
        shepherd_pos = np.array([tuple(b.position) for b in self.shepherds])
        wanted_sheep = self._flock(pos, shepherd_pos)
        size = np.maximum(np.hypot(action[:, 0], action[:, 1]), 1.0)[:, None]
        speed = np.array([body.max_speed for body in scenario.shepherds])[:, None]
        wanted = np.concatenate([wanted_sheep, action / size * speed])
        h = scenario.physics_dt
        for _ in range(scenario.n_substeps):
            for body, target in zip(self.sheep + self.shepherds, wanted, strict=True):
                acceleration = (target - np.array(tuple(body.velocity))) / h
                length = np.hypot(acceleration[0], acceleration[1])
                if length > scenario.max_acceleration:
                    acceleration *= scenario.max_acceleration / length
                body.force = float(acceleration[0]) * body.mass, float(acceleration[1]) * body.mass
            self.space.step(h)
        pos = np.array([tuple(b.position) for b in self.sheep])
        vel = np.array([tuple(b.velocity) for b in self.sheep])
        length = np.linalg.norm(wanted_sheep, axis=1, keepdims=True)
        self.heading = np.where(length > 0, wanted_sheep / np.where(length > 0, length, 1.0), self.heading)
        away = np.linalg.norm(pos - self.goal, axis=1)
        inside = away <= scenario.goal_radius
        for body in np.array(self.sheep, dtype=object)[inside & ~self.arrived]:
            self._mark(body, TAME, 0)
        self.arrived |= inside
        frame, ranges = self._frame()
        self.frames = [*self.frames[1:], frame]
        return PlainStep(
            pos,
            vel,
            np.array([tuple(b.position) for b in self.shepherds]),
            np.concatenate(self.frames, axis=1),
            self._reward(inside, away, ranges),
        )

    def _flock(self, pos: Floats, shepherd_pos: Floats) -> Floats:
        """Strombom et al. 2014 in numpy."""
        m: Strombom = self.scenario.flock
        n = len(pos)
        draws = self.rng.random((n, 2))
        noise = np.stack([np.cos(2 * np.pi * draws[:, 1]), np.sin(2 * np.pi * draws[:, 1])], axis=1)

        def unit(v: Floats) -> Floats:
            length = np.linalg.norm(v, axis=-1, keepdims=True)
            return np.asarray(v / np.where(length > 0, length, 1.0))

        from_shepherd = pos[:, None] - shepherd_pos[None]
        felt = np.linalg.norm(from_shepherd, axis=2) <= m.detection_radius
        r_s = unit((unit(from_shepherd) * felt[..., None]).sum(axis=1))
        between = pos[:, None] - pos[None]
        distance = np.linalg.norm(between, axis=2)
        np.fill_diagonal(distance, np.inf)
        nearest = np.argsort(distance, axis=1, kind="stable")[:, : min(m.n_neighbours, n - 1)]
        c = unit(pos[nearest].mean(axis=1) - pos)
        r_a = unit((unit(between) * (distance < m.sheep_distance)[..., None]).sum(axis=1))
        h = m.inertia * self.heading + m.attraction * c + m.repulsion * r_a + m.flight * r_s + m.noise * noise
        direction = np.where(np.linalg.norm(h, axis=1, keepdims=True) > 0, unit(h), self.heading)
        threatened = felt.any(axis=1)
        grazes_on = draws[:, 0] < m.graze_probability
        wanted = np.where(threatened[:, None], direction, noise * grazes_on[:, None])
        return np.asarray(wanted * self.scenario.sheep.max_speed)

    def _frame(self) -> tuple[NDArray[np.float32], dict[str, Floats]]:
        """Encoded frame (P, 3, beams), and the ranges (P, beams) that the rewards read."""
        lidar, beams = self.lidar, self.lidar.beams
        names = {"sheep": WILD | TAME, "shepherds": SHEPHERD, "wild": WILD}
        ranges = {name: np.full((len(self.shepherds), beams), np.inf) for name in (*names, "goal")}
        for k, body in enumerate(self.shepherds):
            start = (body.position.x, body.position.y)
            for name, mask in names.items():
                shape_filter = pymunk.ShapeFilter(group=k + 1, mask=mask)
                for b, (cos, sin) in enumerate(self.beams):
                    end = (start[0] + lidar.range * cos, start[1] + lidar.range * sin)
                    hit = self.space.segment_query_first(start, end, 0.0, shape_filter)
                    if hit is not None:
                        ranges[name][k, b] = hit.alpha * lidar.range
            ranges["goal"][k] = self._goal_ranges(np.array(start))
        frame = np.zeros((len(self.shepherds), 3, beams), dtype=np.float32)
        for c, name in enumerate(lidar.channels):
            reach = lidar.goal_range if name == "goal" else lidar.range
            frame[:, c] = np.maximum(0.0, 1.0 - ranges[name] / reach)
        return frame, ranges

    def _goal_ranges(self, start: Floats) -> Floats:
        to_goal = self.goal - start
        along = self.beams @ to_goal
        square = along**2 - to_goal @ to_goal + self.scenario.goal_radius**2
        root = np.sqrt(np.maximum(square, 0.0))
        near = np.where(to_goal @ to_goal <= self.scenario.goal_radius**2, along + root, along - root)
        return np.where((square >= 0) & (near >= 0) & (near <= self.lidar.goal_range), near, np.inf)

    def _reward(self, inside: NDArray[np.bool_], away: Floats, ranges: dict[str, Floats]) -> float:
        """The ``wild`` scheme."""
        n, t = len(inside), self.scenario.n_steps
        outside = ~inside
        distance = (1.0 + np.maximum(away[outside] - self.scenario.goal_radius, 0.0)).sum() / (n * t)
        seen, goal = ranges["wild"], ranges["goal"]
        occluded = np.isfinite(goal) & (seen >= 2.0) & (seen <= np.minimum(goal, 10.0))
        return float(10 * inside.sum() / (n * t) - 0.1 * distance + 0.1 * occluded.sum() / (len(self.shepherds) * t))
