"""El-Fiqi's controller: nearest strays are collected, the rest fan out behind, and no one walks through the flock.

El-Fiqi et al. 2020 (IEEE Access 8:214658-214671), from the first author's own code. Flock with centroid Lambda, sheep
p_i, goal G, M shepherds; radii R1 (the flock), R2 (from flock to shepherd), R3 (as far beyond as a shepherd is felt):

* strays: |p_i - Lambda| > R1. In the order of their numbers shepherds take the stray nearest to themselves, each its
  own; it is collected from P_c = p_i + R2 unit(p_i - Lambda);
* the others drive: the first from P_d = Lambda - (R1 + R2) unit(G - Lambda), each further one dtheta = pi / (2 M) to
  the left or right of a reference shepherd, as far from Lambda as that one is now: the second and third refer to
  the first, the fourth to the second, the fifth to the third, ..;
* force = unit(to the target) + 0.5 repulsion by shepherds within 2 m + 2 repulsion by obstacles within 5 m
  + 0.3 jitter, each component of the jitter uniform in +-0.05; times top speed, no stopping. Repulsion is a sum of
  unit(away) exp(-mu d / range), mu = 2, that by shepherds over sqrt(number within range);
* no disturbance: r_safe = max(max |p_i - Lambda|, R1) + R2 + R3. A step into that circle whose bearing from Lambda
  differs from the target's by more than 0.2 rad is replaced by one round the circle of radius min(r_safe, distance now
  + step), the shorter way.

Deviations of the literal variant: angles are wrapped, which the code forgets; obstacles, discs there, repel from
their surface.

The tuned team works on one sub-flock at a time and has a terminal rule (`shepherd_phys.controllers.formation`); its
drivers fan out to fixed places instead of following one another, and it walks round at the berth that all tuned
teams keep.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from shepherd_phys.settings import Settings, settings
from shepherd_phys.state import Floats, WorldState, centroid, unit

from .formation import SubFlocks, Team, TeamSettings
from .places import bearing_of, heading, in_order, limited, wrapped

MU = 2.0
"""mu, how fast repulsion fades."""
SHEPHERD_WEIGHT, SHEPHERD_RANGE = 0.5, 2.0
"""Of the repulsion between shepherds; range in [m]."""
OBSTACLE_WEIGHT, OBSTACLE_RANGE = 2.0, 5.0
"""Of the repulsion by obstacles; range in [m]."""
JITTER_WEIGHT, JITTER = 0.3, 0.05
"""Of the jitter, and eta, the largest size of its components."""
ENTRY = 0.2
"""Half the wedge about the target's bearing within which a shepherd may enter the circle [rad]."""


@settings
class ElfiqiSettings(TeamSettings):
    """Lengths in metres; symbols of the 2020 paper."""

    flock_radius: float = Field(default=5.0, gt=0)
    """R1: a sheep further than this from the centroid is a stray."""
    collect_standoff: float = Field(default=4.0, gt=0)
    """R2 behind a stray."""
    drive_distance: float = Field(default=8.5, gt=0)
    """R1 + R2 behind the centroid."""


TUNED = ElfiqiSettings(
    stop_distance=2.5,
    link=2.5,
    let_go=3.5,
    ring=10.5,
    ring_out=12.0,
    crumb=0.7,
    loyalty=4.0,
    berth=9.5,
    flock_radius=5.0,
    collect_standoff=4.0,
    drive_distance=9.0,
)
"""What the team plays with. Found by ``shepherd-phys tune --controller elfiqi --rounds 4 --candidates 8 --seed 0``,
version 0.1.0; the record is docs/tuning/elfiqi.toml."""


class Elfiqi(Team):
    """The tuned team: one sub-flock at a time, a terminal rule.

    Args:
        settings: its lengths; `TUNED` unless given.
    """

    def __init__(self, settings: ElfiqiSettings | None = None) -> None:
        self.settings = settings or TUNED
        super().__init__(self.settings)

    def _targets(self, state: WorldState, flocks: SubFlocks) -> Floats:
        s, flock, m = self.settings, flocks.sheep[0], state.n_shepherds
        gcm = flocks.centers[0]
        stray = nearest_strays(state.shepherd_pos, flock, s.flock_radius)
        targets = collecting_places(flock, stray, s.collect_standoff)
        drivers = np.flatnonzero(stray < 0)
        behind = bearing_of(gcm - state.goal_pos)
        theta = (np.arange(len(drivers)) - (len(drivers) - 1) / 2) * np.pi / (2 * m)
        slots = behind + theta
        taken = in_order(bearing_of(state.shepherd_pos[drivers] - gcm), slots)
        targets[drivers] = gcm + s.drive_distance * heading(slots[taken])
        return targets


@settings
class ElfiqiRadii(Settings):
    """The paper's radii [m]."""

    flock: float = Field(default=5.0, gt=0)
    """R1."""
    separation: float = Field(default=4.0, gt=0)
    """R2."""
    influence: float = Field(default=10.0, ge=0)
    """R3."""


class ElfiqiLiteral:
    """The method as published: one centroid, no terminal rule.

    Args:
        settings: its radii.
    """

    lidar = None

    def __init__(self, settings: ElfiqiRadii | None = None) -> None:
        self.settings = settings or ElfiqiRadii()

    def reset(self, rng: np.random.Generator) -> None:
        """Take the episode's generator."""
        self._rng = rng

    def to_dict(self) -> dict[str, Any]:
        """Its parameters."""
        return self.settings.to_dict()

    def act(self, observation: NDArray[np.float32], state: WorldState) -> NDArray[np.float64]:
        """(P, 2)."""
        s, pos = self.settings, state.shepherd_pos
        targets = elfiqi_targets(state, s.flock, s.separation)
        jitter = self._rng.uniform(-JITTER, JITTER, pos.shape)
        force = unit(targets - pos) + SHEPHERD_WEIGHT * shepherd_repulsion(pos) + JITTER_WEIGHT * jitter
        if state.obstacles:
            distance, away = state.surroundings.static_distances(pos)
            size = np.where(distance < OBSTACLE_RANGE, np.exp(-MU * np.maximum(distance, 0.0) / OBSTACLE_RANGE), 0.0)
            force = force + OBSTACLE_WEIGHT * (size[:, :, None] * away).sum(axis=1)
        step = (state.shepherd_max_speed * state.control_dt)[:, None]
        gcm = centroid(state.sheep_pos)
        reach = float(np.hypot(*(state.sheep_pos - gcm).T).max())
        safe = max(reach, s.flock) + s.separation + s.influence
        following = undisturbing(pos, pos + step * force, targets, gcm, safe, step[:, 0])
        return limited((following - pos) / step)


def nearest_strays(pos: Floats, flock: Floats, flock_radius: float) -> NDArray[np.int64]:
    """(P,) the row in ``flock`` of the stray that each shepherd takes, in the order of their numbers; -1: it drives.

    Args:
        pos: (P, 2) shepherds [m].
        flock: (K, 2) sheep [m].
        flock_radius: R1 [m].
    """
    left = np.hypot(*(flock - centroid(flock)).T) > flock_radius
    taken = np.full(len(pos), -1, np.int64)
    for k, here in enumerate(pos):
        if not left.any():
            break
        distance = np.where(left, np.hypot(*(flock - here).T), np.inf)
        taken[k] = np.argmin(distance)
        left[taken[k]] = False
    return taken


def collecting_places(flock: Floats, stray: NDArray[np.int64], separation: float) -> Floats:
    """(P, 2) P_c = p_i + R2 unit(p_i - Lambda) of each shepherd with a stray; of no meaning for the others [m]."""
    return np.asarray(flock[stray] + separation * unit(flock[stray] - centroid(flock)))


def elfiqi_targets(state: WorldState, flock_radius: float, separation: float) -> Floats:
    """(P, 2) where each shepherd wants to be: P_c, P_d, or beside its reference shepherd [m].

    Args:
        state: of the world.
        flock_radius: R1 [m].
        separation: R2 [m].
    """
    flock, pos = state.sheep_pos, state.shepherd_pos
    gcm = centroid(flock)
    stray = nearest_strays(pos, flock, flock_radius)
    targets = collecting_places(flock, stray, separation)
    drivers = np.flatnonzero(stray < 0)
    for i, k in enumerate(drivers):
        if i == 0:
            targets[k] = gcm - (flock_radius + separation) * unit(state.goal_pos - gcm)
            continue
        out = pos[drivers[max(i - 2, 0)]] - gcm
        turn = np.pi / (2 * len(pos)) * (-1 if i % 2 else 1)
        targets[k] = gcm + np.hypot(*out) * heading(bearing_of(out) + turn)
    return targets


def shepherd_repulsion(pos: Floats) -> Floats:
    """(P, 2) sum over other shepherds within range of unit(away) exp(-mu d / range), over sqrt(their number)."""
    away = pos[:, None] - pos[None]
    distance = np.hypot(away[..., 0], away[..., 1])
    near = (distance < SHEPHERD_RANGE) & ~np.eye(len(pos), dtype=bool)
    size = np.where(near, np.exp(-MU * distance / SHEPHERD_RANGE), 0.0)
    number = np.maximum(near.sum(axis=1), 1)
    return np.asarray((size[..., None] * unit(away)).sum(axis=1) / np.sqrt(number)[:, None])


def undisturbing(pos: Floats, following: Floats, targets: Floats, center: Floats, safe: float, step: Floats) -> Floats:
    """The next positions (P, 2), those that would disturb the flock replaced by ones round it [m].

    Args:
        pos: (P, 2) shepherds [m].
        following: (P, 2) where they would be next [m].
        targets: (P, 2) [m].
        center: (2,) Lambda [m].
        safe: r_safe [m].
        step: (P,) the length of a step [m].
    """
    out, ahead = pos - center, following - center
    wanted, here = bearing_of(targets - center), bearing_of(out)
    disturbs = (np.hypot(*ahead.T) < safe) & (np.abs(wrapped(wanted - bearing_of(ahead))) > ENTRY)
    radius = np.minimum(safe, np.hypot(*out.T) + step)
    turn = wrapped(wanted - here)
    bearing = here + np.sign(turn) * np.minimum(np.abs(turn), step / radius)
    return np.asarray(np.where(disturbs[:, None], center + radius[:, None] * heading(bearing), following))
