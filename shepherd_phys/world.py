"""`World`: owns the pymunk Space; reset, step, state, scan. How an episode is placed is in `shepherd_phys.stage`.

Speed comes from crossing between Python and C few times: one compiled call for the flock, one for the servo and the
engine steps, one for the measures of the new state, one for all scans.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import pymunk
from numpy.typing import ArrayLike, NDArray

from shepherd_phys import _motion
from shepherd_phys._engine import Engine
from shepherd_phys.bodies import Disc, flies
from shepherd_phys.geometry import SHEEP
from shepherd_phys.imperfections import disturbed
from shepherd_phys.lidar import Lidar, Scan, Sensor
from shepherd_phys.scenario import Scenario
from shepherd_phys.settings import Foreign, SettingsError, check_call, kind_of
from shepherd_phys.stage import Stage, Streams
from shepherd_phys.state import Floats, WorldState, frozen

SHEEP_SETS = {
    "wild": lambda state: ~state.sheep_arrived,
    "outside": lambda state: ~state.sheep_in_goal,
}
"""Sheep that can be scanned on their own: never been in the goal; outside it now."""


class NonFiniteError(FloatingPointError, ValueError):
    """A number that is not finite was about to reach the engine, or came out of it."""


class World:
    """The simulated world of one scenario.

    Every reset sets a fresh `Stage`. An episode is determined by the scenario, the seed and the actions.

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
        self._velocities = getattr(scenario.flock, "velocities", scenario.flock)
        self._flock = kind_of(scenario.flock)  # for errors
        if not callable(self._velocities):
            raise SettingsError(f"flock ({self._flock}): needs 'velocities', or to be a function like it")
        check_call(self._velocities, ("state", "rng"), f"flock ({self._flock})")
        for kind, body in {kind_of(body): body for body in (*scenario.shepherds, *scenario.sheep_kinds)}.items():
            if hasattr(body, "follow"):
                check_call(body.follow, ("pose", "wanted", "dt"), f"{kind}.follow")
        if callable(scenario.layout):
            check_call(scenario.layout, ("rng", "site"), f"layout ({kind_of(scenario.layout)})")
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
        return self._start(seed)

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
        return self._start(seed, state)

    def _start(self, seed: int, arrangement: WorldState | None = None) -> WorldState:
        """Set the stage, and read the first state."""
        self._state = None  # a reset that fails leaves no half-made world to step
        scenario, n, p = self.scenario, self._n, self._p
        streams = Streams.of(seed)
        self._noise, self._acting_rng = streams.noise, streams.acting
        self.user_rng, self.sensing_rng = streams.users, streams.sensing
        stage = Stage(scenario, streams, arrangement)
        self.space, self._shapes, self._geometry = stage.space, stage.shapes, stage.geometry
        self._contacts = stage.contacts

        agents = (*scenario.sheep_bodies, *scenario.shepherds)
        self._speed = frozen(np.array([float(body.max_speed) for body in scenario.shepherds]))
        self._goal = frozen(np.array(stage.goal, dtype=np.float64))
        self._constant = {
            "goal_pos": self._goal,
            "goal_radius": scenario.goal_radius,
            "sheep_radius": frozen(stage.radius[:n].copy()),
            "sheep_max_speed": frozen(np.array([float(body.max_speed) for body in agents[:n]])),
            "shepherd_radius": frozen(stage.radius[n:].copy()),
            "shepherd_max_speed": self._speed,
            "obstacles": stage.obstacles,
            "surroundings": stage.surroundings,
            "control_dt": scenario.control_dt,
        }
        self._mass = np.array([body.mass for body in stage.bodies])
        self._moment = np.array([body.moment for body in stage.bodies])
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
        self._engine.bind(stage.space, n + p, self._spins)
        rows = self._engine.rows
        self._state = self._measure(rows, 0, stage.heading, stage.arrived, rows[n : n + p, :2], np.zeros(p))
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
        wanted = self._velocities(state, self._noise)
        try:
            wanted = np.asarray(wanted, dtype=np.float64)
        except (TypeError, ValueError):
            raise ValueError(f"flock model ({self._flock}): velocities must be numbers (given: {wanted!r})") from None
        if wanted.shape != (self._n, 2):
            raise ValueError(
                f"flock model ({self._flock}): velocities need shape ({self._n}, 2) (given: {wanted.shape})"
            )
        if not _motion.command_sheep(wanted, command):
            raise NonFiniteError(f"flock model ({self._flock}): velocities must be finite")

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
