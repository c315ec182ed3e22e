"""The Strombom heuristic for a team: collect distinct outliers, else drive in a V; literal and tuned.

Strombom et al. 2014 (J. R. Soc. Interface 11:20140719), one shepherd S, sheep A_i, centroid GCM = mean A_i, N sheep:

* any |A_i - S| < 3 r_a: the shepherd does not move;
* else some |A_i - GCM| > f(N) = r_a N^(2/3): collect, target P_c = A_f + r_a unit(A_f - GCM), A_f the furthest sheep;
* else drive, target P_d = GCM + r_a sqrt(N) unit(GCM - goal);
* S <- S + delta_s unit(unit(target - S) + e eps).

For M shepherds (the V formation of Fujioka 2018, distinct outliers): shepherd k collects the k-th furthest outlier;
those left over drive at GCM + r_a sqrt(N) Rot(theta_k) unit(GCM - goal), theta_k = (k - (M - 1) / 2) 35 degrees.

At this scale (r_a = 0.4 m, shepherds felt at 10 m) the r_a-scaled stand-offs stand inside the flock and scatter it. The
tuned controller keeps the two modes and the V, with stand-offs of its own, and adds what the method as published has no
answer to: one sub-flock at a time and a terminal rule (`shepherd_phys.controllers.formation`).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from shepherd_phys.settings import settings
from shepherd_phys.state import Floats, WorldState, centroid, unit

from .formation import Team, TeamSettings, walk


@settings
class StrombomSettings(TeamSettings):
    """Lengths in metres, angles in radians; symbols of the 2014 paper.

    The defaults were tuned by hand on a few episodes of the tuning seeds (three shepherds, one and two flocks).
    """

    collect_standoff: float = Field(default=4.0, gt=0)
    """Behind an outlier; r_a in the paper."""
    drive_standoff: float = Field(default=8.5, gt=0)
    """Behind the centroid; r_a sqrt(N) in the paper."""
    flock_radius: float = Field(default=5.0, gt=0)
    """f(N): a sheep further than this from the centroid is an outlier; r_a N^(2/3) in the paper."""
    v_angle: float = Field(default=np.deg2rad(35.0), ge=0)
    """Between neighbouring shepherds of the V (Fujioka 2018)."""


class StrombomTeam(Team):
    """The tuned team: sub-flock by sub-flock, own stand-offs, a terminal rule.

    Args:
        settings: its lengths.
    """

    def __init__(self, settings: StrombomSettings | None = None) -> None:
        self.settings = settings or StrombomSettings()
        super().__init__(self.settings)

    def _targets(self, state: WorldState, flocks: list[Floats]) -> Floats:
        s = self.settings
        return team_targets(state, flocks[0], s.flock_radius, s.collect_standoff, s.drive_standoff, s.v_angle)


class StrombomLiteral:
    """The method as published, with the V of its team extension: r_a-scaled stand-offs, one centroid, no terminal rule.

    Args:
        sheep_distance: r_a [m].
        noise: e.
    """

    lidar = None

    def __init__(self, sheep_distance: float = 0.4, noise: float = 0.3) -> None:
        self.sheep_distance = sheep_distance
        self.noise = noise

    def reset(self, rng: np.random.Generator) -> None:
        """Take the episode's generator."""
        self._rng = rng

    def to_dict(self) -> dict[str, Any]:
        """Its parameters."""
        return {"sheep_distance": self.sheep_distance, "noise": self.noise}

    def act(self, observation: NDArray[np.float32], state: WorldState) -> NDArray[np.float64]:
        """(P, 2)."""
        r_a, n = self.sheep_distance, state.n_sheep
        targets = team_targets(
            state, state.sheep_pos, r_a * n ** (2 / 3), r_a, r_a * np.sqrt(n), float(np.deg2rad(35.0))
        )
        return walk(state, targets, 3 * r_a, self.noise, self._rng)


def team_targets(
    state: WorldState, flock: Floats, flock_radius: float, collect: float, drive: float, v_angle: float
) -> Floats:
    """Where each shepherd wants to be: behind an outlier of its own, or in its slot of the V.

    Args:
        state: of the world; its goal and shepherds are read.
        flock: (K, 2) sheep to work on [m].
        flock_radius: f(N) [m].
        collect: stand-off behind an outlier [m].
        drive: stand-off behind the centroid [m].
        v_angle: between neighbours of the V [rad].

    Returns:
        (P, 2) positions [m].
    """
    p = state.n_shepherds
    gcm = centroid(flock)
    spread = flock - gcm
    far = np.hypot(spread[:, 0], spread[:, 1])
    behind = unit(gcm - state.goal_pos)
    if not behind.any():  # the centroid on the goal's centre: any side will do
        behind = np.array([1.0, 0.0])
    theta = (np.arange(p) - (p - 1) / 2) * v_angle
    cos, sin = np.cos(theta), np.sin(theta)
    targets = gcm + drive * np.stack([cos * behind[0] - sin * behind[1], sin * behind[0] + cos * behind[1]], axis=1)
    furthest = np.argsort(-far, kind="stable")[:p]
    outliers = furthest[far[furthest] > flock_radius]
    targets[: len(outliers)] = flock[outliers] + collect * unit(spread[outliers])
    return np.asarray(targets)
