"""`Replay`: an episode as it was, every state bit for bit, in one file; `Recorder`: the env that makes one.

A file holds the states themselves and the actions, not the actions alone. To read it needs no physics, no controller
and none of a user's own classes, and gives the same bits on every machine; the actions are there so that `verify` can
play the episode again and tell whether this machine and this version still come to the same. Files are read and written
by `shepherd_phys.replay_file`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, Protocol

import numpy as np
import pymunk
from numpy.typing import NDArray

from shepherd_phys._version import __version__
from shepherd_phys.geometry import Geometry, surfaces
from shepherd_phys.obstacles import Obstacle, Outline
from shepherd_phys.scenario import SUCCESS_FRACTION, Scenario
from shepherd_phys.settings import Foreign, tagged
from shepherd_phys.state import Floats, WorldState, frozen
from shepherd_phys.world import World

CONSTANT = ("goal_pos", "sheep_radius", "sheep_max_speed", "shepherd_radius", "shepherd_max_speed")
"""Arrays of a `WorldState` that an episode does not change."""
CHANGING = (
    "sheep_pos",
    "sheep_vel",
    "sheep_heading",
    "sheep_goal_distance",
    "sheep_in_goal",
    "sheep_arrived",
    "shepherd_pos",
    "shepherd_vel",
    "shepherd_angle",
    "shepherd_path",
    "collisions",
)
"""What differs from state to state."""


class ReplayError(ValueError):
    """A replay cannot be made, read or written, or does not come out again as it was; one line."""


@dataclass(frozen=True)
class Stored(Foreign):
    """An obstacle of a user's own class, read from a file without that class: its name, values and outlines."""

    outlines: tuple[Outline, ...] = ()
    """Of its shapes."""

    def __hash__(self) -> int:
        return hash(self.kind)

    def shapes(self, body: pymunk.Body) -> list[pymunk.Shape]:
        """Shapes as they were when the file was written."""
        return [outline.shape(body) for outline in self.outlines]


@dataclass(frozen=True, eq=False)
class Replay:
    """An episode of T control steps: ``replay[t]`` is the state after t steps, ``len(replay)`` is T + 1.

    N sheep, P shepherds; the arrays are read-only. Made by a `Recorder`, or read by `load_replay`.
    """

    controller: str
    """Who moved the shepherds, by name. It is text and names nothing to be imported."""
    parameters: Mapping[str, Any]
    """The controller's, as plain data, where it tells them."""
    scenario_name: str
    """By which the scenario was asked for; may be empty."""
    scenario: Scenario
    seed: int
    """Of the env's reset."""
    version: str
    """Of the package that played it."""
    obstacles: tuple[Obstacle, ...]
    """The solid things of the episode, those that a layout drew included."""
    constants: Mapping[str, NDArray[Any]]
    """The arrays named in `CONSTANT`, as a `WorldState` has them."""
    states: Mapping[str, NDArray[Any]]
    """The fields named in `CHANGING`, each with T + 1 rows, one a state."""
    actions: Floats
    """(T, P, 2) as they were given to the env."""
    rewards: Mapping[str, Floats]
    """Name of a reward term -> (T,) its weighted value in each step."""

    @property
    def n_steps(self) -> int:
        """T: control steps that were made."""
        return len(self.actions)

    @property
    def n_sheep(self) -> int:
        """N."""
        return int(self.states["sheep_pos"].shape[1])

    @property
    def n_shepherds(self) -> int:
        """P."""
        return int(self.actions.shape[1])

    @property
    def in_goal(self) -> NDArray[np.int64]:
        """(T + 1,) sheep in the goal."""
        return np.asarray(np.count_nonzero(self.states["sheep_in_goal"], axis=1), dtype=np.int64)

    @property
    def success(self) -> bool:
        """Whether at least 95 % of the sheep are in the goal at the end."""
        return bool(self.in_goal[-1] / self.n_sheep >= SUCCESS_FRACTION)

    def threatened(self, step: int) -> NDArray[np.bool_]:
        """(N,) whether a shepherd is within the flock model's detection radius; false where it tells none."""
        radius = detection_radius(self.scenario.flock)
        between = self.states["sheep_pos"][step][:, None] - self.states["shepherd_pos"][step][None]
        return np.asarray((np.hypot(between[..., 0], between[..., 1]) <= radius).any(axis=1))

    def __len__(self) -> int:
        return self.n_steps + 1

    def __getitem__(self, step: int) -> WorldState:
        if not -len(self) <= step < len(self):
            raise IndexError(f"step {step}: the replay has the states 0 to {self.n_steps}")
        step %= len(self)
        changing: dict[str, Any] = {name: values[step] for name, values in self.states.items()}
        changing["collisions"] = int(changing["collisions"])
        return WorldState.of(
            {
                **self.constants,
                **changing,
                "step": step,
                "time": step * self.scenario.control_dt,
                "goal_radius": self.scenario.goal_radius,
                "obstacles": self.obstacles,
                "control_dt": self.scenario.control_dt,
                "surroundings": self._surroundings,
            }
        )

    def __iter__(self) -> Iterator[WorldState]:
        return (self[step] for step in range(len(self)))

    @cached_property
    def _surroundings(self) -> Geometry:
        return surfaces(self.obstacles)

    def verify(self, report: Callable[[int], None] | None = None) -> None:
        """Play the actions again in a fresh world of the scenario and the seed, and compare every state, bit for bit.

        Args:
            report: called after each step with its number.

        Raises:
            ReplayError: names the first step that differs, and in what.
            SettingsError: the scenario has classes of somebody's own that were not handed over.
        """
        world = World(self.scenario)
        played = world.reset(self.seed)
        for step, recorded in enumerate(self):
            if step:
                played = world.step(self.actions[step - 1])
            differs = difference(recorded, played)
            if differs is not None:
                other = "" if self.version == __version__ else f" (recorded by version {self.version}: {__version__})"
                raise ReplayError(f"step {step}: {differs} differs from the recorded one when played again{other}")
            if report is not None:
                report(step)


def difference(one: WorldState, other: WorldState) -> str | None:
    """Name of the first field in which two states differ by a single bit; None where they do not.

    Obstacles are compared by what a file would say of them.
    """
    for field in fields(WorldState):
        a, b = getattr(one, field.name), getattr(other, field.name)
        if field.name == "obstacles":
            same = [tagged(thing) for thing in a] == [tagged(thing) for thing in b]
        else:
            a, b = np.asarray(a), np.asarray(b)
            same = a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
        if not same:
            return field.name
    return None


def detection_radius(flock: Any) -> float:
    """r_s of a flock model [m], 0 where it tells none; of one that is known by name and values only, too."""
    values = flock.values if isinstance(flock, Foreign) else {}
    radius = values.get("detection_radius", getattr(flock, "detection_radius", None))
    return float(radius) if isinstance(radius, int | float) else 0.0


class Env(Protocol):
    """What a recorder needs of an env (`shepherd_phys.envs.ShepherdingEnv` has it)."""

    @property
    def scenario(self) -> Scenario:
        """What its world holds."""
        ...

    @property
    def state(self) -> WorldState:
        """The latest state of the world."""
        ...

    @property
    def user_rng(self) -> np.random.Generator:
        """The stream for the controller."""
        ...

    def reset(self, *, seed: int | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode."""
        ...

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """One control step."""
        ...


class Recorder:
    """An env that remembers its present episode; to be used in the place of the env that it is given.

    Args:
        env: its reward scheme is what the replay has of rewards. A wrapper that changes actions on their way makes
            replays that show what happened, but are not played again the same.
    """

    def __init__(self, env: Env) -> None:
        self._env = env
        self._world: Env = getattr(env, "unwrapped", env)  # wrappers of Gymnasium hide what they do not know
        self._seed: int | None = None
        self._states: list[WorldState] = []
        self._actions: list[Floats] = []
        self._rewards: list[dict[str, float]] = []

    @property
    def state(self) -> WorldState:
        """The env's."""
        return self._world.state

    @property
    def user_rng(self) -> np.random.Generator:
        """The env's."""
        return self._world.user_rng

    def reset(self, *, seed: int | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode, and forget the one before.

        Raises:
            ReplayError: no seed is given: the episode could not be played again.
        """
        if seed is None:
            raise ReplayError("seed: an episode that is recorded needs one")
        answer = self._env.reset(seed=seed)
        self._seed = int(seed)
        self._states, self._actions, self._rewards = [self.state], [], []
        return answer

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """One control step of the env."""
        kept = np.array(action, dtype=np.float64)
        answer = self._env.step(action)
        self._actions.append(kept)
        self._states.append(self.state)
        terms = {name.removeprefix("reward/"): value for name, value in answer[4].items() if name.startswith("reward/")}
        self._rewards.append(terms)
        return answer

    def replay(
        self, controller: str = "", parameters: Mapping[str, Any] | None = None, scenario_name: str = ""
    ) -> Replay:
        """The episode up to now.

        Args:
            controller: the name of who moved the shepherds.
            parameters: of that controller, plain data.
            scenario_name: by which the scenario was asked for.

        Raises:
            ReplayError: no step has been made.
        """
        if self._seed is None or not self._actions:
            raise ReplayError("nothing has been recorded: reset the recorder with a seed and make a step")
        first = self._states[0]
        return Replay(
            controller=controller,
            parameters=dict(parameters or {}),
            scenario_name=scenario_name,
            scenario=self._world.scenario,
            seed=self._seed,
            version=__version__,
            obstacles=first.obstacles,
            constants={name: getattr(first, name) for name in CONSTANT},
            states={name: _column(self._states, name) for name in CHANGING},
            actions=frozen(np.stack(self._actions)),
            rewards={
                name: frozen(np.array([terms[name] for terms in self._rewards], dtype=np.float64))
                for name in self._rewards[0]
            },
        )


def _column(states: Sequence[WorldState], name: str) -> NDArray[Any]:
    """A field of many states, (states, ..)."""
    return frozen(np.stack([np.asarray(getattr(state, name)) for state in states]))
