"""`Wander`: what a shepherd does whose policy gets it nowhere.

A policy sees a few frames and remembers nothing. Where it sees no goal or no sheep for an obstacle, or stands just
beyond what sheep feel and waits, nothing changes what it sees, and it stays for good. Some steps at random change that.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray
from pydantic import Field

from shepherd_phys.settings import Settings, settings


@settings
class Wander(Settings):
    """For a shepherd that does not see a herd that is home: if a running mean of the velocities that it wants has been
    short for some time, it walks at full speed in a random direction for a while, or until it sees the herd home.
    Nobody sees that from within the goal, from where whoever stands still walks off. Lengths of time are in decisions
    of the deployed policy; the figures given here are for one each control step of 0.2 s.
    """  # noqa: D205

    home: float = Field(default=3.0, ge=0)
    """So far outside the goal's border [m] the point that is seen of a sheep is still home."""
    memory: float = Field(default=0.02, gt=0, le=1)
    """Part that a decision makes of the mean; at 0.02 it reaches some 50 decisions back: ten seconds."""
    least: float = Field(default=0.2, gt=0, le=1)
    """Means shorter than this part of the top speed are short."""
    after: int = Field(default=30, ge=1, le=100_000)
    """Decisions for which it must have been short, those of the last walk among them."""
    shortest: int = Field(default=10, ge=1, le=100_000)
    """Least decisions of a walk."""
    longest: int = Field(default=29, ge=1, le=100_000)
    """Most decisions of a walk."""

    def __post_init__(self) -> None:
        if self.longest < self.shortest:
            raise ValueError(f"longest: must be at least shortest, {self.shortest} (given: {self.longest})")


class Wanderer:
    """Who of a team wanders, in one episode.

    Args:
        settings: the settings.
        rng: of the episode; directions and lengths of walks are drawn from it.
    """

    def __init__(self, settings: Wander, rng: np.random.Generator) -> None:
        self.settings = settings
        self._rng = rng
        self._mean: NDArray[np.float64] | None = None
        self._short = np.zeros(0, np.int64)
        self._left = np.zeros(0, np.int64)
        self._way = np.zeros((0, 2))

    def __call__(self, wanted: NDArray[np.float64], home: NDArray[np.bool_]) -> NDArray[np.float64]:
        """What the team does (P, 2) where its policy wants ``wanted`` (P, 2); who sees the herd ``home`` (P,) stays."""
        own = self.settings
        if self._mean is None:
            n = len(wanted)
            self._mean, self._way = wanted.copy(), np.zeros((n, 2))
            self._short, self._left = np.zeros(n, np.int64), np.zeros(n, np.int64)
        done = wanted.copy()
        if _wait(done, home, own.memory, own.least, own.after, self._mean, self._short, self._left, self._way):
            for p in np.flatnonzero((self._short >= own.after) & (self._left == 0)):
                angle = self._rng.uniform(0.0, 2.0 * np.pi)
                self._way[p] = np.cos(angle), np.sin(angle)
                self._left[p] = self._rng.integers(own.shortest, own.longest, endpoint=True)
                self._short[p] = 0
            _walk(home, self._way, self._left, done)
        return done


@njit(cache=True, error_model="numpy")
def _wait(done, home, memory, least, after, mean, short, left, way):  # type: ignore[no-untyped-def]
    """Count for how many decisions the mean of what is wanted, ``done`` (P, 2), has been short.

    Whether somebody is to begin a walk; if nobody is, those that are under way are written into ``done``.
    """
    any_due = False
    for p in range(len(done)):
        mean[p, 0] += memory * (done[p, 0] - mean[p, 0])
        mean[p, 1] += memory * (done[p, 1] - mean[p, 1])
        short[p] = short[p] + 1 if math.hypot(mean[p, 0], mean[p, 1]) < least and not home[p] else 0
        any_due = any_due or (short[p] >= after and left[p] == 0)
    if not any_due:
        _walk(home, way, left, done)
    return any_due


@njit(cache=True, error_model="numpy")
def _walk(home, way, left, done):  # type: ignore[no-untyped-def]
    """Write a step of the walks into ``done`` (P, 2); those of who sees the herd home end."""
    for p in range(len(done)):
        if home[p]:
            left[p] = 0
        elif left[p] > 0:
            left[p] -= 1
            done[p] = way[p]
