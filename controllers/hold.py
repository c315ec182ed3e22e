"""`Hold`: how a team that acts by a policy holds the herd once it is home.

A policy tells by how wide the goal looks where to stand when all are home, and so it stands too far off a larger one to
press in what does not fit unpressed; and an output that is never quite 0 creeps. This corrects both, by what a shepherd
sees with its own lidar, and leaves the policy alone until the shepherd sees sheep, and all of them are home.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray
from pydantic import Field

from shepherd_phys.lidar import Lidar, beam_directions
from shepherd_phys.settings import Settings, SettingsError, settings


@settings
class Hold(Settings):
    """For a shepherd that sees the goal from outside, and sheep, all of them home.

    Its action towards the goal is at least as many metres as it is outside the ring, 1 at most; where the whole action
    is then short it stands still, so up to ``rest`` metres outside. Along the ring it moves as the policy wants: that
    is what spreads a team.

    What it goes by is what it sees. Sheep that others hide, or that are out of range, count for nothing. A goal of
    which an obstacle hides one side looks narrower, and so nearer, by its radius at most; noise on ranges makes its
    nearest point look nearer, and the ring that much wider: 5 % by 0.9 m.
    """

    ring: float = Field(default=10.5, gt=0)
    """Radius of the ring about the goal's centre [m]: sheep feel shepherds from 10 m."""
    inside: float | None = Field(default=None, ge=0)
    """So far inside the ring [m] it may stand: from nearer its action is at least the metres back, 1 at most. None: as
    near as the policy wants."""
    home: float = Field(default=3.0, ge=0)
    """So far outside the goal's border [m] the point that is seen of a sheep is still home."""
    rest: float = Field(default=0.4, ge=0, lt=1)
    """Wanted speeds below this part of the top speed mean standing still."""
    team: int = Field(default=3, ge=1, le=1000)
    """Shepherds of the smallest team that holds so: fewer would press the herd out on the far side."""

    def __post_init__(self) -> None:
        if self.inside is not None and self.inside > self.ring:
            raise ValueError(f"inside: must be no more than ring, {self.ring} (given: {self.inside})")


def check_sight(lidar: Lidar, field: str) -> None:
    """Find out whether somebody with this lidar can tell that the herd is home, which ``field`` needs.

    Raises:
        SettingsError: the goal is not straight ahead, or no sheep are seen.
    """
    if lidar.frame != "goal" or "sheep" not in lidar.channels:
        raise SettingsError(f"{field}: needs the frame 'goal' and the channel of sheep (given: {lidar})")


class HomeHerd:
    """Tells shepherds that see the herd home how far the goal's centre is.

    Args:
        lidar: the settings.
        home: so far outside the goal's border a sheep is still home [m].
    """

    def __init__(self, lidar: Lidar, home: float) -> None:
        rows = lidar.channels.index("goal"), lidar.channels.index("sheep")
        self._settings = (*rows, lidar.goal_range, lidar.range, beam_directions(lidar.beams), home)

    def __call__(self, frames: NDArray[np.float32], offset: NDArray[np.int64]) -> NDArray[np.float64]:
        """Distances (P,) of the goal's centre [m] for those who see the herd home; NaN for others.

        They see the goal from outside, and sheep, none of them further outside its border than ``home``.

        Args:
            frames: (P, stack, channels, beams) proximities of all beams in the world frame, newest last.
            offset: (P,) the beams that point at the goal.
        """
        distances = np.empty(len(frames))
        _home_herd(frames, offset, distances, *self._settings)
        return distances


@njit(cache=True, error_model="numpy")
def _home_herd(frames, offset, out, goal, sheep, goal_range, sheep_range, directions, home):  # type: ignore[no-untyped-def]
    """Of the rows ``goal`` and ``sheep`` of the newest frame.

    A disc of radius r whose centre is d away looks 2 a wide, sin a = r / d, and its nearest point is d - r away. Its
    width is that of the circle without the widest gap between lit beams: beams that are lost within it do not matter.
    """
    n, stack, _, beams = frames.shape
    out[:] = math.nan
    for p in range(n):
        goals, flock = frames[p, stack - 1, goal], frames[p, stack - 1, sheep]
        first, last, gap, near = -1, -1, 0, 0.0
        for k in range(beams):
            x = goals[k]
            if x > 0.0:
                if first < 0:
                    first = k
                else:
                    gap = max(gap, k - last)
                last = k
                near = max(near, x)
        width = beams + 1 - max(gap, first + beams - last)
        if first < 0 or 2 * width >= beams:  # no goal to be seen, or from inside it
            continue
        border = goal_range * (1.0 - near)
        centre = border / (1.0 - math.sin(math.pi * width / beams))
        far = centre - border + home
        x, y = centre * directions[0, offset[p]], centre * directions[1, offset[p]]
        for k in range(beams):
            if flock[k] > 0.0:
                out[p] = centre
                d = sheep_range * (1.0 - flock[k])
                if math.hypot(d * directions[0, k] - x, d * directions[1, k] - y) > far:
                    out[p] = math.nan
                    break
