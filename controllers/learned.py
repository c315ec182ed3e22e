"""`Policy`: a controller that was learned, deployed on numpy alone."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Self

import numpy as np
from numba import njit
from numpy.typing import NDArray

from shepherd_phys import mirror
from shepherd_phys.lidar import Lidar, beam_directions
from shepherd_phys.observation import observe
from shepherd_phys.state import WorldState

from .hold import HomeHerd
from .network import Actor
from .policy_files import PolicySpec, checked_weights, read_policy
from .wander import Wanderer

SHIPPED = Path(__file__).parent / "policies"


class Policy:
    """Moves every shepherd by the same network, each by its own observation alone.

    The action is the mean of the distribution that it had while learning, clipped to the unit disc. What else becomes
    of it when it is deployed ``spec.action`` tells; all chance in it is a function of the episode's seed.

    Args:
        spec: what it was trained with.
        weights: of its network, float32 by name.
        checksum: identifies it in results.
        name: for results and messages.

    Raises:
        PolicyError: the weights are not those that the network needs.
    """

    def __init__(
        self, spec: PolicySpec, weights: Mapping[str, NDArray[np.float32]], checksum: str = "", name: str = "policy"
    ) -> None:
        self.spec = spec
        self.weights = checked_weights(weights, spec)
        self.checksum = checksum
        self.name = name
        self._actor = Actor(spec.network, spec.lidar, weights)
        self._frames = (spec.lidar.stack, len(spec.lidar.channels), spec.lidar.beams)
        # in the goal frame each shepherd's roll depends on its last one, which is the controller's to remember: the env
        # gives all beams in the world frame
        self._rolls = spec.lidar.frame == "goal"
        self._observed, self._interval = spec.lidar, spec.action.interval
        self._lidar = spec.lidar.but(frame="world", sectors=None) if self._rolls else spec.lidar
        self._directions = beam_directions(spec.lidar.beams)
        hold = spec.action.hold
        deep = math.inf if hold is None or hold.inside is None else hold.inside
        self._limits = (0.0 if hold is None else hold.rest, deep)
        homes = {what.home for what in (hold, spec.action.wander) if what is not None}
        self._herds = {home: HomeHerd(spec.lidar, home) for home in homes}
        self._chance = np.zeros((0, 2))
        self._outside = np.zeros(0)
        self._deviation = self._actor.deviation if spec.action.noise else np.zeros(2, np.float32)
        self._offset: NDArray[np.int64] | None = None
        self._action: NDArray[np.float64] | None = None
        self._mirrored: NDArray[np.bool_] | None = None
        self._wanderer: Wanderer | None = None
        self.reset(np.random.default_rng(0))

    @classmethod
    def load(cls, path: str | Path, classes: Iterable[Any] = ()) -> Self:
        """Read a policy file; see `load_policy`."""
        spec, weights, checksum = read_policy(path, classes)
        return cls(spec, weights, checksum, Path(path).stem)

    @property
    def lidar(self) -> Lidar:
        """What the env must deliver."""
        return self._lidar

    def reset(self, rng: np.random.Generator) -> None:
        """Forget the last episode."""
        self._offset = self._action = self._mirrored = None
        self._rng = rng
        wander = self.spec.action.wander
        self._wanderer = None if wander is None else Wanderer(wander, rng)

    def act(self, observation: NDArray[np.float32], state: WorldState) -> NDArray[np.float64]:
        """(P, 2).

        Args:
            observation: (P, stack x channels, beams or sectors) by the settings ``lidar``.
            state: only its clock is read.

        Raises:
            ValueError: the episode began with a team of another size.
        """
        n = len(observation)
        if n == 0:
            return np.zeros((0, 2))
        if self._offset is None:
            self._offset, self._chance = np.zeros(n, np.int64), np.zeros((n, 2))
            self._outside = np.full(n, np.nan)
        if len(self._offset) != n:
            raise ValueError(
                f"observation: is of {n} shepherds, in an episode that began with {len(self._offset)}; call reset first"
            )
        acting = self.spec.action
        frames = observation.reshape(n, *self._frames) if self._rolls else observation
        if self._rolls:
            observation, self._offset = observe(frames, self._offset, self._observed)
        if acting.noise and (self._action is None or state.step % acting.noise_steps == 0):
            self._chance = acting.noise * self._rng.standard_normal((n, 2))
        if self._action is None or state.step % self._interval == 0:
            if self._mirrored is None:
                self._mirrored = np.zeros(n, np.bool_)
                if acting.mirror != "never":  # which needs the goal straight ahead, and sheep
                    self._mirrored = mirror.mirrored(acting.mirror, observation, self._observed)
            mean = self._actor(observation, self._mirrored)
            hold, wander = acting.hold, acting.wander
            away = {home: herd(frames, self._offset) for home, herd in self._herds.items()}
            outside = away[hold.home] - hold.ring if hold is not None and n >= hold.team else self._outside
            self._action = np.empty((n, 2))
            _wanted(
                mean, self._chance, self._deviation, self._mirrored, self._offset, self._directions, acting.rest,
                outside, self._limits, self._action,
            )  # fmt: skip
            if self._wanderer is not None and wander is not None:
                self._action = self._wanderer(self._action, np.isfinite(away[wander.home]))
        return self._action.copy()

    def to_dict(self) -> dict[str, Any]:
        """What identifies it in results."""
        return {"policy": self.checksum}


@njit(cache=True, error_model="numpy")
def _wanted(mean, chance, deviation, mirrored, offset, directions, rest, outside, limits, wanted):  # type: ignore[no-untyped-def]
    """Write a network's actions ``wanted`` (P, 2) as the world takes them: one call costs less than its parts.

    That is the ``mean`` and ``chance`` (P, 2) standard deviations (2,); of those who see in a mirror, ``mirrored``
    (P,), what `shepherd_phys.mirror.meant` makes of it. Clipped to [-1, 1], as while learning, and to the unit disc, as
    the world does; 0 where shorter than ``rest``; turned by the angle of beam ``offset`` (P,), as
    `shepherd_phys.observation.turn` does. ``outside`` (P,) is how far those who hold are outside their ring [m], NaN
    for others; ``limits`` are theirs: what is short for them in place of ``rest``, and how far inside the ring they may
    stand [m].
    """
    for p in range(len(mean)):
        x = mean[p, 0] + chance[p, 0] * deviation[0]
        y = mean[p, 1] + chance[p, 1] * deviation[1]
        x = min(max(x, -1.0), 1.0)
        y = min(max(-y if mirrored[p] else y, -1.0), 1.0)
        slow = rest
        if not math.isnan(outside[p]):
            slow, deep = limits
            if outside[p] > 0.0:
                x = max(x, min(outside[p], 1.0))
            elif outside[p] < -deep:
                x = min(x, max(outside[p] + deep, -1.0))
        if math.hypot(x, y) < slow:
            x = y = 0.0
        length = max(math.hypot(x, y), 1.0)
        cos, sin = directions[0, offset[p]] / length, directions[1, offset[p]] / length
        wanted[p, 0] = cos * x - sin * y
        wanted[p, 1] = sin * x + cos * y


def load_policy(path: str | Path, classes: Iterable[Any] = ()) -> Policy:
    """A controller from a policy file NAME.json, with NAME.safetensors beside it.

    Args:
        path: of the JSON file.
        classes: a user's own classes (of bodies, flock models, obstacles) that its scenario names, for those who want
            to make that scenario's world; acting does not need them.

    Raises:
        PolicyError: the file is missing, damaged or not a policy.
    """
    return Policy.load(path, classes)


POLICIES = {path.stem: partial(load_policy, path) for path in sorted(SHIPPED.glob("*.json"))}
"""The policies that ship with the package by name; each call reads one."""
