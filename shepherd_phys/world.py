"""`World`: owns the pymunk Space; reset, step, state, scan.

Speed comes from crossing between Python and C few times: one compiled call for the flock, one for the servo and the
engine steps, one for the measures of the new state, one for all scans.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np
import pymunk
from numpy.typing import ArrayLike, NDArray

from shepherd_phys import _motion
from shepherd_phys._engine import Engine
from shepherd_phys.bodies import Disc, built, flies
from shepherd_phys.geometry import (
    BEAM_CATEGORY,
    OBSTACLE_CATEGORY,
    OBSTACLES,
    SHEEP,
    SHEEP_CATEGORY,
    SHEPHERD_CATEGORY,
    SHEPHERDS,
    Geometry,
    compile_shapes,
)
from shepherd_phys.imperfections import disturbed
from shepherd_phys.layouts import Site, laid_out
from shepherd_phys.lidar import Lidar, Scan, Sensor
from shepherd_phys.obstacles import Obstacle, solid
from shepherd_phys.placement import PlacementError, flock_of, place, relax
from shepherd_phys.scenario import Scenario
from shepherd_phys.settings import Foreign, SettingsError, kind_of
from shepherd_phys.state import Floats, WorldState, frozen

SHEEP_SETS = {
    "wild": lambda state: ~state.sheep_arrived,
    "outside": lambda state: ~state.sheep_in_goal,
}
"""Sheep that can be scanned on their own: never been in the goal; outside it now."""


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


class NonFiniteError(FloatingPointError, ValueError):
    """A number that is not finite was about to reach the engine, or came out of it."""


class _Contacts:
    """Counts new contacts of shepherds with obstacles and with one another in one Space.

    Engines report pairs of shapes; here bodies and obstacles count, each pair once however many shapes they have.
    """

    def __init__(self, owners: dict[pymunk.Shape, int]) -> None:
        self.count = 0
        self._owners = owners
        self._touching: Counter[tuple[int, int]] = Counter()

    def begin(self, arbiter: pymunk.Arbiter, space: pymunk.Space, data: Any) -> None:
        pair = self._pair(arbiter)
        self.count += self._touching[pair] == 0
        self._touching[pair] += 1

    def separate(self, arbiter: pymunk.Arbiter, space: pymunk.Space, data: Any) -> None:
        self._touching[self._pair(arbiter)] -= 1

    def _pair(self, arbiter: pymunk.Arbiter) -> tuple[int, int]:
        a, b = (self._owners[shape] for shape in arbiter.shapes)
        return min(a, b), max(a, b)


class World:
    """The simulated world of one scenario.

    Every reset makes a fresh Space (a used one would carry contacts over and change the episode), with bodies in a
    fixed order: sheep, shepherds. An episode is determined by the scenario, the seed and the actions.

    Args:
        scenario: what it holds.

    Attributes:
        scenario: the same.
        state: the latest `WorldState`; `reset` makes the first.
        space: the pymunk Space of this episode, to look at.
        user_rng: generator for controllers and users, seeded by `reset` apart from the world's own.
        sensing_rng: the same for what goes wrong with the shepherds' sensors (`shepherd_phys.imperfections.Sight`).
    """

    def __init__(self, scenario: Scenario) -> None:
        things = (*scenario.shepherds, *scenario.sheep_kinds, scenario.flock, *scenario.obstacles, scenario.layout)
        for thing in things:
            if isinstance(thing, Foreign):
                raise thing.missing()
            if isinstance(thing, type):
                raise SettingsError(f"{kind_of(thing)}: a class was given; make one of it: {thing.__name__}()")
        if not hasattr(scenario.flock, "velocities"):
            raise SettingsError(f"flock ({kind_of(scenario.flock)}): a flock model needs 'velocities'")
        self.scenario = scenario
        self._h, self._substeps = scenario.physics_dt, scenario.n_substeps
        self._n = scenario.n_sheep
        self._p = scenario.n_shepherds
        self._state: WorldState | None = None

    @property
    def state(self) -> WorldState:
        """The latest state.

        Raises:
            RuntimeError: there was no reset yet.
        """
        if self._state is None:
            raise RuntimeError("the world has no state yet: call reset first")
        return self._state

    # ------------------------------------------------------------------ reset

    def reset(self, seed: int) -> WorldState:
        """Start the episode of a seed.

        Args:
            seed: not negative; the same seed gives the same episode.

        Raises:
            SettingsError: bodies or obstacles cannot be built, or leave no room.
        """
        scenario = self.scenario
        self._state = None  # a reset that fails leaves no half-made world to step
        placement = self._seed(seed)
        bodies, static = self._new_bodies(scenario.obstacles)
        radius = np.array([reach for _, _, reach in bodies])
        solids = compile_shapes([(shape, -1, OBSTACLES) for shape, _ in static])
        direction, bearing = None, (0.0, 2.0 * math.pi)
        if scenario.flock_spread is not None:
            direction = 2.0 * math.pi * float(self._drawing.random())
            bearing = direction - scenario.flock_spread, direction + scenario.flock_spread
        for _ in range(PLACE_TRIES):
            goal, sheep_pos, shepherd_pos = place(
                placement,
                n_sheep=self._n,
                n_flocks=scenario.n_flocks,
                flock_sizes=scenario.flock_sizes,
                flock_distance=scenario.flock_distance,
                flock_bearing=bearing,
                flock_sd=scenario.flock_sd,
                n_shepherds=self._p,
                box=scenario.box,
                goal_pos=scenario.goal_pos,
            )
            if not static or self._has_room(solids, goal, sheep_pos, shepherd_pos):
                break
        else:
            raise PlacementError(
                f"obstacles: in {PLACE_TRIES} draws they left no room for the goal, a shepherd or a flock's centroid; "
                "fewer or smaller ones, a larger box or another goal_pos make some"
            )
        pos = relax(
            np.concatenate([sheep_pos, shepherd_pos]),
            radius,
            push_out=solids.push_out if static else None,
        )
        obstacles = scenario.obstacles
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
            drawn, pos = laid_out(scenario.layout, self._drawing, site)
            obstacles = (*obstacles, *drawn)
            static = self._shapes_of(obstacles)
        angle = self._noise.uniform(0.0, 2 * np.pi, self._n)
        motion = np.zeros((self._n + self._p, 6))
        motion[:, :2] = pos
        return self._start(
            bodies,
            obstacles,
            static,
            goal,
            motion,
            np.stack([np.cos(angle), np.sin(angle)], axis=1),
            np.zeros(self._n, dtype=np.bool_),
        )

    def _has_room(self, solids: Geometry, goal: Floats, sheep_pos: Floats, shepherd_pos: Floats) -> bool:
        """Whether obstacles leave free the goal (its centre, where it is given), shepherds and flocks' centroids."""
        flock = flock_of(self._n, self.scenario.n_flocks, self.scenario.flock_sizes)
        centroids = np.array([sheep_pos[flock == k].mean(axis=0) for k in range(self.scenario.n_flocks)])
        points = np.concatenate([goal[None], shepherd_pos, centroids])
        wanted = np.zeros(len(points))
        if self.scenario.goal_pos is None:
            wanted[0] = self.scenario.goal_radius
        return bool((solids.static_distances(points)[0].min(axis=1) > wanted).all())

    def reset_to(self, state: WorldState, seed: int) -> WorldState:
        """Start an episode from a given arrangement instead of a drawn one.

        Args:
            state: where everything is, how it moves and which sheep have arrived; its clock and what it has counted
                are not taken over, its obstacles only where the scenario has a layout. Make one with
                ``world.reset(0).but(sheep_pos=..)``.
            seed: of the sheep's noise and of ``user_rng``.

        Raises:
            ValueError: the state has other numbers of sheep or shepherds than the scenario.
            NonFiniteError: it holds a number that is not finite.
        """
        n, p = self._n, self._p
        if (state.n_sheep, state.n_shepherds) != (n, p):
            raise ValueError(
                f"state: needs {n} sheep and {p} shepherds (given: {state.n_sheep} and {state.n_shepherds})"
            )
        for name, shape in {
            "goal_pos": (2,),
            "sheep_pos": (n, 2),
            "sheep_vel": (n, 2),
            "sheep_heading": (n, 2),
            "sheep_arrived": (n,),
            "shepherd_pos": (p, 2),
            "shepherd_vel": (p, 2),
            "shepherd_angle": (p,),
        }.items():
            array = getattr(state, name)
            if array.shape != shape:
                raise ValueError(f"state.{name}: needs shape {shape} (given: {array.shape})")
            if not np.isfinite(array).all():
                raise NonFiniteError(f"state.{name}: every number must be finite")
        self._state = None
        self._seed(seed)
        # where a layout draws, the arrangement's own obstacles are a part of it
        obstacles = self.scenario.obstacles if self.scenario.layout is None else state.obstacles
        bodies, static = self._new_bodies(obstacles)
        motion = np.zeros((self._n + self._p, 6))
        motion[:, :2] = np.concatenate([state.sheep_pos, state.shepherd_pos])
        motion[self._n :, 2] = state.shepherd_angle
        motion[:, 3:5] = np.concatenate([state.sheep_vel, state.shepherd_vel])
        return self._start(bodies, obstacles, static, state.goal_pos, motion, state.sheep_heading, state.sheep_arrived)

    def _seed(self, seed: int) -> np.random.Generator:
        """Seed the sheep's noise, the layout's stream and the users'; the stream of the placement is returned."""
        if not isinstance(seed, int | np.integer) or seed < 0:
            raise ValueError(f"seed: needs a whole number that is not negative (given: {seed!r})")
        placement, noise, users, drawing = (np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(4))
        self._noise = noise
        self._drawing = drawing
        self.user_rng = users
        wrong = np.random.SeedSequence(seed, spawn_key=(IMPERFECTIONS_STREAM,)).spawn(2)
        self.sensing_rng, self._acting_rng = (np.random.default_rng(s) for s in wrong)
        return placement

    def _new_bodies(
        self, obstacles: tuple[Obstacle, ...]
    ) -> tuple[list[tuple[pymunk.Body, list[pymunk.Shape], float]], list[tuple[pymunk.Shape, int]]]:
        """A fresh Space, the bodies for it in their fixed order, and shapes of obstacles with the obstacle's index."""
        scenario = self.scenario
        space = pymunk.Space()
        space.iterations = scenario.iterations
        space.collision_slop = scenario.collision_slop
        self.space = space
        bodies = [built(body, "sheep") for body in scenario.sheep_bodies]
        bodies += [built(body, f"shepherd {k}") for k, body in enumerate(scenario.shepherds)]
        return bodies, self._shapes_of(obstacles)

    def _shapes_of(self, obstacles: tuple[Obstacle, ...]) -> list[tuple[pymunk.Shape, int]]:
        """Shapes of obstacles for the Space, each with its obstacle's index."""
        return [
            (shape, index)
            for index, obstacle in enumerate(obstacles)
            for shape in solid(obstacle, index, self.space.static_body)
        ]

    def _start(
        self,
        bodies: list[tuple[pymunk.Body, list[pymunk.Shape], float]],
        obstacles: tuple[Obstacle, ...],
        static: list[tuple[pymunk.Shape, int]],
        goal: Floats,
        motion: Floats,
        heading: Floats,
        arrived: NDArray[np.bool_],
    ) -> WorldState:
        """Fill the Space and read the first state; rows of ``motion`` are x, y, angle, vx, vy, spin."""
        scenario, space = self.scenario, self.space
        agents = (*scenario.sheep_bodies, *scenario.shepherds)
        masks = [BEAM_CATEGORY if flies(body) else pymunk.ShapeFilter.ALL_MASKS() for body in agents]
        self._shapes: list[tuple[pymunk.Shape, int, int]] = []
        for row, (body, shapes, _) in enumerate(bodies):
            is_sheep = row < self._n
            category = SHEEP_CATEGORY if is_sheep else SHEPHERD_CATEGORY
            x, y, angle, vx, vy, spin = motion[row].tolist()
            body.position = x, y
            body.velocity = vx, vy
            body.angle, body.angular_velocity = angle, spin
            for shape in shapes:
                # a group of its own lets a shepherd's beams pass its own shapes
                shape.filter = pymunk.ShapeFilter(
                    group=0 if is_sheep else row - self._n + 1, categories=category, mask=masks[row]
                )
                shape.collision_type = category
                self._shapes.append((shape, row, SHEEP if is_sheep else SHEPHERDS))
            space.add(body, *shapes)
        owners = {shape: row for shape, row, channel in self._shapes if channel == SHEPHERDS}
        for shape, index in static:
            owners[shape] = -1 - index
            shape.filter = pymunk.ShapeFilter(categories=OBSTACLE_CATEGORY)
            shape.collision_type = OBSTACLE_CATEGORY
            self._shapes.append((shape, -1, OBSTACLES))
            space.add(shape)
        self._contacts = _Contacts(owners)
        for other in (OBSTACLE_CATEGORY, SHEPHERD_CATEGORY):
            space.on_collision(SHEPHERD_CATEGORY, other, begin=self._contacts.begin, separate=self._contacts.separate)

        n, p = self._n, self._p
        radius = np.array([reach for _, _, reach in bodies])
        self._geometry = compile_shapes(self._shapes)
        if n + p >= HASH_FROM and self._geometry.known:
            space.use_spatial_hash(HASH_CELL * float(np.median(radius)), 4 * (n + p))
        self._speed = frozen(np.array([float(body.max_speed) for body in scenario.shepherds]))
        self._sheep_speed = frozen(np.array([float(body.max_speed) for body in agents[:n]]))
        self._goal = frozen(np.array(goal, dtype=np.float64))
        self._constant = {
            "goal_pos": self._goal,
            "goal_radius": scenario.goal_radius,
            "sheep_radius": frozen(radius[:n].copy()),
            "sheep_max_speed": self._sheep_speed,
            "shepherd_radius": frozen(radius[n:].copy()),
            "shepherd_max_speed": self._speed,
            "obstacles": obstacles,
            "surroundings": compile_shapes([(shape, -1, OBSTACLES) for shape, _ in static]),
            "control_dt": scenario.control_dt,
        }
        self._mass = np.array([body.mass for body, _, _ in bodies])
        self._moment = np.array([body.moment for body, _, _ in bodies])
        # a body of infinite moment cannot spin: where that holds for all, angles are neither read nor written
        self._spins = bool(np.isfinite(self._moment).any())
        self._followers = [(row, body) for row, body in enumerate(agents) if type(body) is not Disc]
        self._flying = [flies(body) for body in scenario.shepherds]
        self._sensors: dict[Lidar, Sensor] = {}
        self._sensor: Sensor | None = None

        self._command = np.zeros((n + p, 3))
        self._poses = np.zeros((n + p, 3))
        if "_engine" not in self.__dict__:
            self._engine = Engine()  # not before the first reset, so that a fresh world can be pickled
        self._engine.bind(space, n + p, self._spins)
        rows = self._engine.rows
        self._state = self._measure(rows, 0, heading, arrived, rows[n : n + p, :2], np.zeros(p))
        return self._state

    # ------------------------------------------------------------------- step

    def step(self, action: ArrayLike) -> WorldState:
        """One control step.

        Args:
            action: (P, 2) wanted velocities over top speed, world axes; longer than 1 is clipped to the unit disc.

        Raises:
            ValueError: the action has another shape.
            NonFiniteError: the action, or what the flock model wants, is not finite; nothing has moved.
        """
        state, scenario = self.state, self.scenario
        try:
            action = np.asarray(action, dtype=np.float64)
        except (TypeError, ValueError):
            raise ValueError(f"action: needs numbers of shape ({self._p}, 2) (given: {action!r})") from None
        if action.shape != (self._p, 2):
            raise ValueError(f"action: needs shape ({self._p}, 2), one row a shepherd (given: {action.shape})")
        command = self._command
        wrong = scenario.imperfections
        if wrong is not None and wrong.action_noise > 0 and np.isfinite(action).all():
            action = disturbed(action, wrong.action_noise, self._acting_rng)
        # before the flock draws its random numbers: a refused action must change nothing
        if not _motion.command_shepherds(action, self._speed, command):
            raise NonFiniteError("action: every number must be finite")
        flock = type(scenario.flock).__name__
        wanted = scenario.flock.velocities(state, self._noise)
        try:
            wanted = np.asarray(wanted, dtype=np.float64)
        except (TypeError, ValueError):
            raise ValueError(f"flock model ({flock}): velocities must be numbers (given: {wanted!r})") from None
        if wanted.shape != (self._n, 2):
            raise ValueError(f"flock model ({flock}): velocities need shape ({self._n}, 2) (given: {wanted.shape})")
        if not _motion.command_sheep(wanted, command):
            raise NonFiniteError(f"flock model ({flock}): velocities must be finite")

        limits = scenario.max_acceleration, scenario.max_angular_acceleration
        if self._followers:
            for _ in range(self._substeps):
                followed = self._follow(self._engine.rows, self._h)
                rows = self._engine.drive(followed, self._mass, self._moment, self._h, 1, *limits)
        else:
            rows = self._engine.drive(command, self._mass, self._moment, self._h, self._substeps, *limits)

        self._state = self._measure(
            rows,
            state.step + 1,
            state.sheep_heading,
            state.sheep_arrived,
            state.shepherd_pos,
            state.shepherd_path,
        )
        return self._state

    def _follow(self, rows: Floats, h: float) -> Floats:
        """Let the bodies that are no plain discs turn what is wanted of them into what they do."""
        followed = self._command.copy()
        for row, body in self._followers:
            name = type(body).__name__
            pose = rows[row].copy() if self._spins else np.array([*rows[row, :2], 0.0, *rows[row, 2:], 0.0])
            answer = body.follow(pose, self._command[row, :2].copy(), h)
            try:
                (followed[row, 0], followed[row, 1]), followed[row, 2] = answer
            except (TypeError, ValueError):
                raise ValueError(f"{name}.follow: needs a velocity (2,) and a spin (given: {answer!r})") from None
            if not all(map(math.isfinite, followed[row])):
                raise NonFiniteError(f"{name}.follow: velocity and spin must be finite (given: {answer!r})")
        return followed

    def _measure(
        self, rows: Floats, step: int, heading: Floats, arrived: NDArray[np.bool_], previous: Floats, path: Floats
    ) -> WorldState:
        """Make the state of what was read."""
        scenario, n, p = self.scenario, self._n, self._p
        # allocated here and not in the kernel: handing arrays over costs less than bringing them back; and few of them,
        # of which the state's are slices: to make and to freeze each by itself took longer than to fill them
        vectors, numbers, flags = np.empty((3 * n + 2 * p, 2)), np.empty(n + 2 * p), np.empty((2, n), np.bool_)
        if not _motion.measure(
            rows, self._command, heading, arrived, previous, path, self._goal, scenario.goal_radius,
            vectors, numbers, flags, self._poses,
        ):  # fmt: skip
            raise NonFiniteError("the engine gave positions or velocities that are not finite")
        for array in (vectors, numbers, flags):
            array.setflags(write=False)
        return WorldState.of(
            {
                **self._constant,
                "step": step,
                "time": step * scenario.control_dt,
                "sheep_pos": vectors[:n],
                "sheep_vel": vectors[n : 2 * n],
                "sheep_heading": vectors[2 * n : 3 * n],
                "sheep_goal_distance": numbers[:n],
                "sheep_in_goal": flags[0],
                "sheep_arrived": flags[1],
                "shepherd_pos": vectors[3 * n : 3 * n + p],
                "shepherd_vel": vectors[3 * n + p :],
                "shepherd_angle": numbers[n : n + p],
                "shepherd_path": numbers[n + p :],
                "collisions": self._contacts.count,
            }
        )

    # ------------------------------------------------------------------- scan

    def scan(self, lidar: Lidar, sets: tuple[str, ...] = ()) -> Scan:
        """What every shepherd's lidar reads now.

        Args:
            lidar: its settings.
            sets: names of `SHEEP_SETS` to scan on their own besides.
        """
        state = self.state
        sensor = self._sensor
        if sensor is None or sensor.lidar is not lidar:  # the usual one is found without hashing its settings
            sensor = self._sensors.get(lidar)
            if sensor is None:
                sheep_shapes: list[list[pymunk.Shape]] = [[] for _ in range(self._n)]
                for shape, row, channel in self._shapes:
                    if channel == SHEEP:
                        sheep_shapes[row].append(shape)
                sensor = Sensor(lidar, self._geometry, self.space, sheep_shapes, self._n, self._p, self._flying)
                self._sensors[lidar] = sensor
            self._sensor = sensor
        for name in sets:
            if name not in SHEEP_SETS:
                raise ValueError(f"sets: {name!r} is not one of {', '.join(SHEEP_SETS)}")
        masks: Mapping[str, NDArray[np.bool_]] = {name: SHEEP_SETS[name](state) for name in sets}
        return sensor.scan(self._poses, state.goal_pos, state.goal_radius, masks)
