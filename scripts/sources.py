"""Where the pictures of ``watch`` come from: `Live`, an episode being played, or `Recorded`, one from a file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np

from shepherd_phys.controllers.evaluation import ControllerError, checked_action, trial_seed
from shepherd_phys.envs.rewards import SCHEMES, earning_beams
from shepherd_phys.envs.shepherding import ShepherdingEnv
from shepherd_phys.lidar import Lidar, Scan
from shepherd_phys.replay import Replay
from shepherd_phys.scenario import Scenario
from shepherd_phys.settings import SettingsError
from shepherd_phys.state import Floats, WorldState, unit
from shepherd_phys.workers import explain

from .points import Point, find_controller


@dataclass(frozen=True)
class Frame:
    """What there is to see at the end of a control step."""

    state: WorldState
    over: bool
    """Whether it is the episode's last."""
    scan: Scan | None = None
    earning: Floats | None = None
    """(P, beams) lengths of the beams that earn reward [m], infinity for the others; None where none can."""
    rewards: Mapping[str, float] = field(default_factory=dict)
    """What each term has given since the start, weighted."""


class Source(Protocol):
    """Frames, one a control step, from the start of an episode to its end."""

    @property
    def name(self) -> str:
        """Who is to be seen."""
        ...

    @property
    def label(self) -> str:
        """Which episode it is."""
        ...

    @property
    def scenario(self) -> Scenario:
        """Of the episode."""
        ...

    @property
    def steerable(self) -> bool:
        """Whether `advance` heeds what it is told."""
        ...

    def restart(self, *, onward: bool = False) -> Frame:
        """The first frame: of the same episode, or, going onward, of the next one where there is one."""
        ...

    def advance(self, taken: Mapping[int, Floats]) -> Frame:
        """The next frame; not called after the last one.

        Args:
            taken: actions (2,) of the shepherds that somebody has taken over.
        """
        ...


@contextmanager
def _in_one_line() -> Iterator[None]:
    """Whatever a user's own classes raise becomes one line that says where.

    Raises:
        SettingsError: one of them raised something.
    """
    try:
        yield
    except (SettingsError, ControllerError):
        raise
    except Exception as error:
        raise SettingsError(explain(error)) from None


def shown_name(controller: str) -> str:
    """A controller's name for a title: of a policy's file its folder and its name, since each run has a ``best``."""
    path = Path(controller)
    return "/".join([*path.parts[-2:-1], path.stem]).lstrip("/") if path.suffix == ".json" else controller


class Live:
    """An episode that is being played: trial i of ``evaluate --seed``, step for step, while nobody interferes.

    Args:
        point: controller and scenario.
        seed: the root seed.
        trial: the first episode to be shown; going onward is the next trial.
        rewards: a scheme's name.

    Raises:
        ControllerError: the controller is none.
        SettingsError: the world cannot be made.
    """

    steerable = True

    def __init__(self, point: Point, seed: int, trial: int = 0, rewards: str = "wild") -> None:
        self.scenario = point.scenario
        self.controller = find_controller(point.controller)
        self.name = shown_name(point.controller)
        self._seed, self._trial = seed, trial
        self._scheme = SCHEMES[rewards]
        # a controller that needs no scan is given one nevertheless: its beams are to be seen
        lidar = self.controller.lidar or Lidar(channels=self.scenario.channels)
        self.env = ShepherdingEnv(self.scenario, rewards, lidar)

    @property
    def label(self) -> str:
        """Trial and root seed."""
        return f"trial {self._trial} of seed {self._seed}"

    @_in_one_line()
    def restart(self, *, onward: bool = False) -> Frame:
        """The trial's first frame, or the next trial's."""
        self._trial += onward
        self._observation, _ = self.env.reset(seed=trial_seed(self._seed, self._trial))
        self.controller.reset(self.env.user_rng)
        self._sums = dict.fromkeys(self._scheme, 0.0)
        return self._frame(over=False)

    @_in_one_line()
    def advance(self, taken: Mapping[int, Floats]) -> Frame:
        """One control step."""
        action = checked_action(self.controller.act(self._observation, self.env.state), self.controller, self.env.state)
        if taken:
            action = action.copy()
            for shepherd, wanted in taken.items():
                action[shepherd] = wanted
        self._observation, _, terminated, truncated, info = self.env.step(action)
        for name in self._sums:
            self._sums[name] += float(info[f"reward/{name}"])
        return self._frame(over=bool(terminated or truncated))

    def _frame(self, *, over: bool) -> Frame:
        scan = self.env.scan
        return Frame(self.env.state, over, scan, earning_beams(self._scheme, scan), dict(self._sums))


class Recorded:
    """An episode from a file, as it was. There are no scans in it: no beams are to be seen, and nobody can interfere.

    Args:
        replay: the episode.
    """

    steerable = False

    def __init__(self, replay: Replay) -> None:
        self.replay = replay
        self.scenario = replay.scenario
        self.name = shown_name(replay.controller)
        self.label = f"seed {replay.seed}"
        # what each term has given until a state: 0 at first
        self._sums = {name: np.concatenate([[0.0], np.cumsum(values)]) for name, values in replay.rewards.items()}

    def restart(self, *, onward: bool = False) -> Frame:
        """The first frame; there is no other episode to go onward to."""
        self._step = 0
        return self._frame()

    def advance(self, taken: Mapping[int, Floats]) -> Frame:
        """The next state."""
        self._step += 1
        return self._frame()

    def _frame(self) -> Frame:
        rewards = {name: float(values[self._step]) for name, values in self._sums.items()}
        return Frame(self.replay[self._step], self._step >= self.replay.n_steps, rewards=rewards)


def between(before: WorldState, after: WorldState, share: float) -> WorldState:
    """What is to be seen a ``share`` of the way from one state to the next: places, headings, angles and the time."""
    heading = before.sheep_heading + share * (after.sheep_heading - before.sheep_heading)
    turn = np.remainder(after.shepherd_angle - before.shepherd_angle + np.pi, 2 * np.pi) - np.pi
    return before.but(
        sheep_pos=before.sheep_pos + share * (after.sheep_pos - before.sheep_pos),
        sheep_heading=unit(heading),
        shepherd_pos=before.shepherd_pos + share * (after.shepherd_pos - before.shepherd_pos),
        shepherd_vel=before.shepherd_vel + share * (after.shepherd_vel - before.shepherd_vel),
        shepherd_angle=before.shepherd_angle + share * turn,
        time=before.time + share * (after.time - before.time),
    )
