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

import math
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from pydantic import Field

from shepherd_phys.settings import settings
from shepherd_phys.state import Floats, WorldState

from .formation import SubFlocks, Team, TeamSettings
from .places import walk


@settings
class StrombomSettings(TeamSettings):
    """Lengths in metres, angles in radians; symbols of the 2014 paper."""

    collect_standoff: float = Field(default=4.0, gt=0)
    """Behind an outlier; r_a in the paper."""
    drive_standoff: float = Field(default=8.5, gt=0)
    """Behind the centroid; r_a sqrt(N) in the paper."""
    flock_radius: float = Field(default=5.0, gt=0)
    """f(N): a sheep further than this from the centroid is an outlier; r_a N^(2/3) in the paper."""
    v_angle: float = Field(default=np.deg2rad(35.0), ge=0)
    """Between neighbouring shepherds of the V (Fujioka 2018)."""


TUNED = StrombomSettings(
    stop_distance=1.54,
    link=4.7,
    let_go=4.22,
    ring=10.56,
    ring_out=12.04,
    crumb=0.63,
    loyalty=4.18,
    berth=8.33,
    collect_standoff=2.99,
    drive_standoff=8.69,
    flock_radius=5.3,
    v_angle=0.46,
)
"""What the team plays with. Found by ``shepherd-phys tune --controller strombom --rounds 4 --candidates 8 --seed 0``,
version 0.1.0; the record is docs/tuning/strombom.toml."""


class StrombomTeam(Team):
    """The tuned team: sub-flock by sub-flock, own stand-offs, a terminal rule.

    Args:
        settings: its lengths; `TUNED` unless given.
    """

    def __init__(self, settings: StrombomSettings | None = None) -> None:
        self.settings = settings or TUNED
        super().__init__(self.settings)

    def _targets(self, state: WorldState, flocks: SubFlocks) -> Floats:
        s = self.settings
        return team_targets(state, flocks.sheep[0], s.flock_radius, s.collect_standoff, s.drive_standoff, s.v_angle)


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
    return np.asarray(_team_targets(flock, state.goal_pos, state.n_shepherds, flock_radius, collect, drive, v_angle))


@njit(cache=True)
def _team_targets(flock, goal, p, flock_radius, collect, drive, v_angle):  # type: ignore[no-untyped-def]
    gcm = np.zeros(2)
    for i in range(len(flock)):
        gcm += flock[i]
    gcm /= len(flock)
    far = np.empty(len(flock))
    for i in range(len(flock)):
        far[i] = math.hypot(flock[i, 0] - gcm[0], flock[i, 1] - gcm[1])
    x, y = gcm[0] - goal[0], gcm[1] - goal[1]
    behind = math.atan2(y, x)  # 0 with the centroid on the goal's centre: any side will do
    targets = np.empty((p, 2))
    for k in range(p):
        theta = behind + (k - (p - 1) / 2) * v_angle
        targets[k, 0] = gcm[0] + drive * math.cos(theta)
        targets[k, 1] = gcm[1] + drive * math.sin(theta)
    for k in range(min(p, len(flock))):
        furthest = np.argmax(far)
        if not far[furthest] > flock_radius:
            break
        scale = 1 + collect / far[furthest]
        targets[k, 0] = gcm[0] + scale * (flock[furthest, 0] - gcm[0])
        targets[k, 1] = gcm[1] + scale * (flock[furthest, 1] - gcm[1])
        far[furthest] = -1.0
    return targets
