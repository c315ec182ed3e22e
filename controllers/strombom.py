"""The Strombom heuristic for a team: collect distinct outliers, else drive in a V; literal and tuned.

Strombom et al. 2014 (J. R. Soc. Interface 11:20140719), one shepherd S, sheep A_i, centroid GCM = mean A_i, N sheep:

* any |A_i - S| < 3 r_a: the shepherd does not move;
* else some |A_i - GCM| > f(N) = r_a N^(2/3): collect, target P_c = A_f + r_a unit(A_f - GCM), A_f the furthest sheep;
* else drive, target P_d = GCM + r_a sqrt(N) unit(GCM - goal);
* S <- S + delta_s unit(unit(target - S) + e eps).

For M shepherds (the V formation of Fujioka 2018, distinct outliers): shepherd k collects the k-th furthest outlier;
those left over drive at GCM + r_a sqrt(N) Rot(theta_k) unit(GCM - goal), theta_k = (k - (M - 1) / 2) 35 degrees.

At this scale (r_a = 0.4 m, shepherds felt at 10 m) the r_a-scaled stand-offs stand inside the flock and scatter it. The
tuned controller keeps the two modes and the V and adds what the method as published has no answer to:

* stand-offs of its own;
* split flocks: the centroid between two flocks means nothing, so it works on one sub-flock (single linkage) at a time;
* it walks round a flock, and round what is delivered, not through it;
* a terminal rule: it never drives from nearer to the goal than the ring at which shepherds hold a flock, lets go once
  the flock is home, and then rings the goal.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from shepherd_phys.settings import Settings, settings
from shepherd_phys.state import Floats, WorldState, centroid, sub_flocks, unit

WEDGE = 0.35
"""How far ahead along the edge of a disc a shepherd aims that walks round it [rad]."""


@settings
class StrombomSettings(Settings):
    """Lengths in metres, angles in radians; symbols of the 2014 paper.

    The defaults were tuned by hand on a few episodes of the tuning seeds (three shepherds, one and two flocks).
    """

    collect_standoff: float = Field(default=4.0, gt=0)
    """Behind an outlier; r_a in the paper."""
    drive_standoff: float = Field(default=8.5, gt=0)
    """Behind the centroid; r_a sqrt(N) in the paper."""
    flock_radius: float = Field(default=5.0, gt=0)
    """f(N): a sheep further than this from the centroid is an outlier; r_a N^(2/3) in the paper."""
    stop_distance: float = Field(default=2.0, ge=0)
    """A shepherd this near to a sheep does not move on; 3 r_a in the paper."""
    v_angle: float = Field(default=np.deg2rad(35.0), ge=0)
    """Between neighbouring shepherds of the V (Fujioka 2018)."""
    noise: float = Field(default=0.0, ge=0)
    """e, weight of a random direction in the shepherd's own; 0.3 in the paper."""
    link: float = Field(default=3.0, gt=0)
    """Sheep nearer than this belong to one sub-flock."""
    let_go: float = Field(default=3.0, ge=0)
    """A sub-flock is home when its furthest sheep is within the goal's radius plus this of the goal's centre."""
    ring: float = Field(default=10.5, gt=0)
    """Distance from the goal's centre at which shepherds hold a delivered flock, and nearer than which none drives."""
    ring_out: float = Field(default=11.0, gt=0)
    """The same for a team of one or two, which cannot ring the flock evenly and must not push it."""
    berth: float = Field(default=9.0, ge=0)
    """Nearer than this to a flock's centroid no shepherd passes on its way to the other side."""


class StrombomTeam:
    """The tuned team: sub-flock by sub-flock, own stand-offs, a terminal rule.

    Args:
        settings: its lengths.
    """

    lidar = None

    def __init__(self, settings: StrombomSettings | None = None) -> None:
        self.settings = settings or StrombomSettings()

    def reset(self, rng: np.random.Generator) -> None:
        """Take the episode's generator."""
        self._rng = rng

    def to_dict(self) -> dict[str, Any]:
        """Its parameters."""
        return self.settings.to_dict()

    def act(self, observation: NDArray[np.float32], state: WorldState) -> NDArray[np.float64]:
        """(P, 2)."""
        s = self.settings
        ring = s.ring if state.n_shepherds >= 3 else s.ring_out
        flock = self._active(state)
        if flock is None:
            targets = round_about(state.shepherd_pos, self._ring(state, ring), state.goal_pos, ring)
            return walk(state, targets, 0.0, s.noise, self._rng)
        targets = team_targets(state, flock, s.flock_radius, s.collect_standoff, s.drive_standoff, s.v_angle)
        away = targets - state.goal_pos
        near = np.hypot(away[:, 0], away[:, 1]) < ring
        targets = np.where(near[:, None], state.goal_pos + ring * unit(away), targets)
        targets = round_about(state.shepherd_pos, targets, centroid(flock), s.berth)
        if state.sheep_in_goal.any():
            targets = round_about(state.shepherd_pos, targets, state.goal_pos, ring)
        return walk(state, targets, s.stop_distance, s.noise, self._rng)

    def _active(self, state: WorldState) -> Floats | None:
        """Positions of the sub-flock to work on, or None when all are home.

        The one whose furthest sheep is nearest to the goal comes first: it is soonest done.
        """
        out = np.hypot(*(state.sheep_pos - state.goal_pos).T)
        label = sub_flocks(state.sheep_pos, self.settings.link)
        home = state.goal_radius + self.settings.let_go
        reach = np.zeros(label.max() + 1)
        np.maximum.at(reach, label, out)
        reach[reach <= home] = np.inf
        best = int(np.argmin(reach))
        if not np.isfinite(reach[best]):
            return None
        return np.asarray(state.sheep_pos[label == best])

    def _ring(self, state: WorldState, radius: float) -> Floats:
        """(P, 2) evenly spaced places round the goal, each shepherd near to where it is."""
        p = state.n_shepherds
        away = state.shepherd_pos - state.goal_pos
        bearing = np.arctan2(away[:, 1], away[:, 0])
        order = np.argsort(bearing)
        slots = 2 * np.pi * np.arange(p) / max(p, 1)
        # the turn of the whole ring that moves the team least
        turn = np.angle(np.exp(1j * (bearing[order] - slots)).sum())
        place = np.empty(p)
        place[order] = slots + turn
        return np.asarray(state.goal_pos + radius * np.stack([np.cos(place), np.sin(place)], axis=1))


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


def round_about(pos: Floats, targets: Floats, center: Floats, radius: float) -> Floats:
    """Where to walk now so as to reach targets round a disc instead of through it.

    A shepherd whose straight way leads through the disc walks along its edge, the shorter way round; one inside
    walks outwards and on.

    Args:
        pos: (P, 2) where the shepherds are [m].
        targets: (P, 2) where they want to be [m].
        center: (2,) of the disc [m].
        radius: of the disc [m].

    Returns:
        (P, 2) the next places to walk to [m].
    """
    way, out = targets - pos, pos - center
    length = np.hypot(way[:, 0], way[:, 1])
    ahead = -(way * out).sum(axis=1)  # of the centre along the way, times its length
    cross = way[:, 0] * -out[:, 1] - way[:, 1] * -out[:, 0]
    through = (length > 0) & (ahead > 0) & (ahead < length**2) & (np.abs(cross) < radius * length * (1 - 1e-9))
    here = np.arctan2(out[:, 1], out[:, 0])
    goal = np.arctan2(*(targets - center).T[::-1])
    turn = np.angle(np.exp(1j * (goal - here)))
    bearing = here + np.sign(turn) * np.minimum(np.abs(turn), WEDGE)
    edge = center + max(radius, 1e-9) * np.stack([np.cos(bearing), np.sin(bearing)], axis=1)
    return np.asarray(np.where(through[:, None], edge, targets))


def walk(state: WorldState, targets: Floats, stop: float, noise: float, rng: np.random.Generator) -> Floats:
    """Actions that take each shepherd to its target: full speed, slower only to arrive on it.

    Args:
        state: of the world.
        targets: (P, 2) [m].
        stop: a shepherd nearer than this to a sheep does not move [m].
        noise: weight e of a random direction.
        rng: where that comes from.

    Returns:
        (P, 2) actions.
    """
    way = targets - state.shepherd_pos
    direction = unit(way)
    if noise > 0:
        angle = rng.uniform(0.0, 2 * np.pi, len(way))
        direction = unit(direction + noise * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    step = state.shepherd_max_speed * state.control_dt
    size = np.minimum(np.hypot(way[:, 0], way[:, 1]) / step, 1.0)
    if stop > 0:
        near = np.hypot(*(state.sheep_pos[None] - state.shepherd_pos[:, None]).transpose(2, 0, 1)).min(axis=1)
        size = np.where(near < stop, 0.0, size)
    return np.asarray(direction * size[:, None])
