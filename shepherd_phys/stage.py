"""`Stage`: a Space with everything in its place, from which an episode starts: drawn, or as a state has it."""

from __future__ import annotations

import math
from collections import Counter
from typing import Any, NamedTuple

import numpy as np
import pymunk

from shepherd_phys.bodies import built, flies
from shepherd_phys.geometry import (
    BEAM_CATEGORY,
    OBSTACLE_CATEGORY,
    OBSTACLES,
    SHEEP,
    SHEEP_CATEGORY,
    SHEPHERD_CATEGORY,
    SHEPHERDS,
    Geometry,
    Owned,
    compile_shapes,
)
from shepherd_phys.layouts import Site, laid_out
from shepherd_phys.obstacles import Obstacle, solid
from shepherd_phys.placement import PlacementError, flock_of, place, relax
from shepherd_phys.scenario import Scenario
from shepherd_phys.state import Bools, Floats, WorldState

PLACE_TRIES = 200
"""Draws of a placement among obstacles after which it is given up."""

IMPERFECTIONS_STREAM = 1_000
"""Spawn key of the streams of imperfect sensing and acting: far from those that an episode's seed spawns."""

HASH_FROM = 1_000
"""Bodies from which the engine finds contacts by a spatial hash and not by its tree: a quarter faster among 10,000. Not
below, though it is faster there, too: its segment queries lose a beam that runs exactly through a cell's corner, and
the reference lidar is made of them."""
HASH_CELL = 4.7
"""Side of a cell of that hash over the radius of a body (measured: flat from 3 to 7)."""


class Streams(NamedTuple):
    """An episode's streams of random numbers: what is drawn from one leaves the others as they are."""

    placement: np.random.Generator
    """Where goal, sheep and shepherds start."""
    noise: np.random.Generator
    """The sheep's headings at the start, then their noise."""
    users: np.random.Generator
    """For controllers and users."""
    layout: np.random.Generator
    """Direction of the flocks, and obstacles."""
    sensing: np.random.Generator
    """What goes wrong with the shepherds' sensors."""
    acting: np.random.Generator
    """What goes wrong with their drives."""

    @classmethod
    def of(cls, seed: int) -> Streams:
        """The streams of a seed.

        Raises:
            ValueError: it is no whole number, or negative.
        """
        if not isinstance(seed, int | np.integer) or seed < 0:
            raise ValueError(f"seed: needs a whole number that is not negative (given: {seed!r})")
        right = np.random.SeedSequence(seed).spawn(4)
        wrong = np.random.SeedSequence(seed, spawn_key=(IMPERFECTIONS_STREAM,)).spawn(2)
        return cls(*(np.random.default_rng(sequence) for sequence in (*right, *wrong)))


class Contacts:
    """Counts new contacts of shepherds with obstacles and with one another in one Space.

    Engines report pairs of shapes; here bodies and obstacles count, each pair once however many shapes they have.
    """

    def __init__(self, owners: dict[pymunk.Shape, int]) -> None:
        self.count = 0
        self._owners = owners
        self._touching: Counter[tuple[int, int]] = Counter()

    def begin(self, arbiter: pymunk.Arbiter, space: pymunk.Space, data: Any) -> None:
        """Two shapes touch."""
        pair = self._pair(arbiter)
        self.count += self._touching[pair] == 0
        self._touching[pair] += 1

    def separate(self, arbiter: pymunk.Arbiter, space: pymunk.Space, data: Any) -> None:
        """Two shapes part."""
        self._touching[self._pair(arbiter)] -= 1

    def _pair(self, arbiter: pymunk.Arbiter) -> tuple[int, int]:
        a, b = (self._owners[shape] for shape in arbiter.shapes)
        return min(a, b), max(a, b)


class _Start(NamedTuple):
    """Where everything is, and how it moves."""

    goal: Floats
    """(2,) [m]."""
    motion: Floats
    """(N + P, 6) x, y [m], angle [rad], vx, vy [m/s], spin [rad/s], sheep first."""
    heading: Floats
    """(N, 2) unit vectors."""
    arrived: Bools
    """(N,)."""
    obstacles: tuple[Obstacle, ...]
    static: list[tuple[pymunk.Shape, int]]
    """Shapes of the obstacles, each with its obstacle's index."""


class Stage:
    """A fresh Space, everything in it, and what the world knows of it beforehand.

    A used Space would carry contacts over and change the episode. Bodies are added in a fixed order: sheep, shepherds.

    Args:
        scenario: what there is.
        streams: from which an arrangement is drawn.
        state: an arrangement to start from instead; its obstacles are taken over where the scenario has a layout.

    Attributes:
        space: the Space.
        bodies: its bodies, N sheep and P shepherds.
        radius: (N + P,) of the discs that hold them [m].
        shapes: all shapes, those of obstacles last.
        geometry: these, compiled.
        surroundings: those of obstacles alone, compiled.
        obstacles: the scenario's and those that were drawn.
        contacts: the shepherds' new ones are counted here.
        goal: (2,) its centre [m].
        heading: (N, 2) of the sheep, unit vectors.
        arrived: (N,) which sheep have been in the goal.

    Raises:
        SettingsError: bodies or obstacles cannot be built, or leave no room.
    """

    def __init__(self, scenario: Scenario, streams: Streams, state: WorldState | None = None) -> None:
        self.space = space = pymunk.Space()
        space.iterations = scenario.iterations
        space.collision_slop = scenario.collision_slop
        cast = [built(body, "sheep") for body in scenario.sheep_bodies]
        cast += [built(body, f"shepherd {k}") for k, body in enumerate(scenario.shepherds)]
        self.bodies = [body for body, _, _ in cast]
        self.radius = np.array([reach for _, _, reach in cast])
        if state is None:
            start = _drawn(scenario, streams, self.radius, space.static_body)
        else:
            start = _given(scenario, state, space.static_body)
        self.goal, self.heading, self.arrived, self.obstacles = (
            start.goal,
            start.heading,
            start.arrived,
            start.obstacles,
        )
        self.shapes: list[Owned] = []
        self._add_agents(scenario, [shapes for _, shapes, _ in cast], start.motion)
        owners = {shape: row for shape, row, channel in self.shapes if channel == SHEPHERDS}
        for shape, index in start.static:
            owners[shape] = -1 - index
            shape.filter = pymunk.ShapeFilter(categories=OBSTACLE_CATEGORY)
            shape.collision_type = OBSTACLE_CATEGORY
            self.shapes.append((shape, -1, OBSTACLES))
            space.add(shape)
        self.contacts = Contacts(owners)
        for other in (OBSTACLE_CATEGORY, SHEPHERD_CATEGORY):
            space.on_collision(SHEPHERD_CATEGORY, other, begin=self.contacts.begin, separate=self.contacts.separate)
        self.geometry = compile_shapes(self.shapes)
        self.surroundings = _compiled(start.static)
        if len(cast) >= HASH_FROM and self.geometry.known:
            space.use_spatial_hash(HASH_CELL * float(np.median(self.radius)), 4 * len(cast))

    def _add_agents(self, scenario: Scenario, shapes_of: list[list[pymunk.Shape]], motion: Floats) -> None:
        """Move the bodies to their places, and add them with their shapes."""
        n = scenario.n_sheep
        agents = (*scenario.sheep_bodies, *scenario.shepherds)
        for row, (agent, body, shapes) in enumerate(zip(agents, self.bodies, shapes_of, strict=True)):
            is_sheep = row < n
            category = SHEEP_CATEGORY if is_sheep else SHEPHERD_CATEGORY
            mask = BEAM_CATEGORY if flies(agent) else pymunk.ShapeFilter.ALL_MASKS()
            x, y, angle, vx, vy, spin = motion[row].tolist()
            body.position = x, y
            body.velocity = vx, vy
            body.angle, body.angular_velocity = angle, spin
            for shape in shapes:
                # a group of its own lets a shepherd's beams pass its own shapes
                shape.filter = pymunk.ShapeFilter(group=0 if is_sheep else row - n + 1, categories=category, mask=mask)
                shape.collision_type = category
                self.shapes.append((shape, row, SHEEP if is_sheep else SHEPHERDS))
            self.space.add(body, *shapes)


def _drawn(scenario: Scenario, streams: Streams, radius: Floats, ground: pymunk.Body) -> _Start:
    """A drawn arrangement of bodies of these radii; obstacles' shapes are attached to ``ground``."""
    n, p = scenario.n_sheep, scenario.n_shepherds
    obstacles = scenario.obstacles
    static = _static(obstacles, ground)
    solids = _compiled(static)
    direction, bearing = None, (0.0, 2.0 * math.pi)
    if scenario.flock_spread is not None:
        direction = 2.0 * math.pi * float(streams.layout.random())
        bearing = direction - scenario.flock_spread, direction + scenario.flock_spread
    for _ in range(PLACE_TRIES):
        goal, sheep_pos, shepherd_pos = place(
            streams.placement,
            n_sheep=n,
            n_flocks=scenario.n_flocks,
            flock_sizes=scenario.flock_sizes,
            flock_distance=scenario.flock_distance,
            flock_bearing=bearing,
            flock_sd=scenario.flock_sd,
            n_shepherds=p,
            box=scenario.box,
            goal_pos=scenario.goal_pos,
        )
        if not static or _has_room(scenario, solids, goal, sheep_pos, shepherd_pos):
            break
    else:
        raise PlacementError(
            f"obstacles: in {PLACE_TRIES} draws they left no room for the goal, a shepherd or a flock's centroid; "
            "fewer or smaller ones, a larger box or another goal_pos make some"
        )
    pos = relax(np.concatenate([sheep_pos, shepherd_pos]), radius, push_out=solids.clear_by(scenario.body_keep_out))
    if scenario.layout is not None:
        site = Site(
            box=scenario.box,
            goal_pos=goal,
            goal_radius=scenario.goal_radius,
            direction=direction,
            body_pos=pos,
            body_radius=radius,
            goal_keep_out=scenario.goal_keep_out,
            body_keep_out=scenario.body_keep_out,
            fixed=obstacles,
        )
        more, pos = laid_out(scenario.layout, streams.layout, site)
        obstacles = (*obstacles, *more)
        static = _static(obstacles, ground)
    motion = np.zeros((n + p, 6))
    motion[:, :2] = pos
    angle = streams.noise.uniform(0.0, 2 * np.pi, n)
    heading = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return _Start(goal, motion, heading, np.zeros(n, np.bool_), obstacles, static)


def _has_room(scenario: Scenario, solids: Geometry, goal: Floats, sheep_pos: Floats, shepherd_pos: Floats) -> bool:
    """Whether obstacles leave free the goal (its centre, where it is given), shepherds and flocks' centroids."""
    flock = flock_of(scenario.n_sheep, scenario.n_flocks, scenario.flock_sizes)
    centroids = np.array([sheep_pos[flock == k].mean(axis=0) for k in range(scenario.n_flocks)])
    points = np.concatenate([goal[None], shepherd_pos, centroids])
    wanted = np.zeros(len(points))
    if scenario.goal_pos is None:
        wanted[0] = scenario.goal_radius + scenario.goal_keep_out
    return bool((solids.static_distances(points)[0].min(axis=1) > wanted).all())


def _given(scenario: Scenario, state: WorldState, ground: pymunk.Body) -> _Start:
    """The arrangement of a state; obstacles' shapes are attached to ``ground``."""
    n = scenario.n_sheep
    # where a layout draws, the arrangement's own obstacles are a part of it
    obstacles = scenario.obstacles if scenario.layout is None else state.obstacles
    motion = np.zeros((n + scenario.n_shepherds, 6))
    motion[:, :2] = np.concatenate([state.sheep_pos, state.shepherd_pos])
    motion[n:, 2] = state.shepherd_angle
    motion[:, 3:5] = np.concatenate([state.sheep_vel, state.shepherd_vel])
    static = _static(obstacles, ground)
    return _Start(state.goal_pos, motion, state.sheep_heading, state.sheep_arrived, obstacles, static)


def _static(obstacles: tuple[Obstacle, ...], ground: pymunk.Body) -> list[tuple[pymunk.Shape, int]]:
    """Shapes of obstacles, each with its obstacle's index."""
    return [(shape, index) for index, obstacle in enumerate(obstacles) for shape in solid(obstacle, index, ground)]


def _compiled(static: list[tuple[pymunk.Shape, int]]) -> Geometry:
    return compile_shapes([(shape, -1, OBSTACLES) for shape, _ in static])
