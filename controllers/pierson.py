"""Pierson and Schwager's controller: shepherds on an arc behind the flock, wide or narrow as it is to be pushed.

Pierson & Schwager, ICRA 2015 and IEEE T-RO 34(2):517-525, 2018, as four independent re-implementations agree on it. One
flock with centroid s, goal g, m shepherds d_j, sheep that flee with s_dot = sum_j (s - d_j) / |s - d_j|^3:

* the flock heads for the goal: phi = angle of g - s;
* shepherds stand behind it, d_j = s + r [cos(phi + pi + Delta_j), sin(phi + pi + Delta_j)],
  Delta_j = Delta (2 j - m - 1) / (2 m - 2), j = 1 .. m, so that the arc is Delta wide;
* the flock then moves along phi at v = (1 / r^2) sum_j cos Delta_j, sum_j cos Delta_j = sin(m x) / sin(x) with
  x = Delta / (2 m - 2): m for shepherds on one spot, 0 for a ring, Delta_0 = 2 pi (m - 1) / m, falling between;
* a point l ahead of the centroid is drawn to the goal, v = -k [cos phi, sin phi] . (s + l [cos phi, sin phi] - g) =
  k (|g - s| - l); from v follows Delta, so the arc closes to a ring as the flock comes in;
* shepherds follow their places: d_dot_j = K (d_j* - d_j).

The sheep of Strombom et al. move at one speed, so v has no physical inverse here: the push is a fraction v_hat of the
strongest, sum_j cos Delta_j = m v_hat. The gains of the paper are not known; the reconstructed variant states its own.

The tuned team works on one sub-flock at a time and has a terminal rule (`shepherd_phys.controllers.formation`); the
method as published has one centroid and neither.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from pydantic import Field

from shepherd_phys.settings import Settings, settings
from shepherd_phys.state import Floats, WorldState, centroid

from .formation import SubFlocks, Team, TeamSettings
from .places import bearing_of, heading, in_order, limited

HALVINGS = 50
"""Steps of the search for the arc's width."""


@settings
class PiersonSettings(TeamSettings):
    """Lengths in metres, angles in radians."""

    gain: float = Field(default=0.1, gt=0)
    """Push v_hat gained with each metre of the centroid's distance from the goal's centre [1/m]."""
    min_push: float = Field(default=0.5, ge=0, le=1)
    """Least v_hat: without it the ring would close before the flock is in."""
    min_arc: float = Field(default=float(np.deg2rad(60.0)), ge=0)
    """Least Delta: at 0 all shepherds would stand on one spot."""
    standoff: float = Field(default=6.0, ge=0)
    """From the flock's edge, (mean + furthest distance of a sheep from the centroid) / 2, to the arc."""
    min_radius: float = Field(default=7.0, gt=0)
    """Least r."""
    max_radius: float = Field(default=9.0, gt=0)
    """Largest r: shepherds are felt no further than 10 m."""


TUNED = PiersonSettings()
"""What the team plays with. ``shepherd-phys tune --controller pierson --rounds 4 --candidates 8 --seed 0``, version
0.1.0, found nothing better than what was set by hand; the record is docs/tuning/pierson.toml."""


class Pierson(Team):
    """The tuned team: the arc behind one sub-flock at a time, a terminal rule.

    Shepherds take the places of the arc in the order in which they stand round the flock, so that none crosses it.

    Args:
        settings: its lengths and gains; `TUNED` unless given.
    """

    def __init__(self, settings: PiersonSettings | None = None) -> None:
        self.settings = settings or TUNED
        super().__init__(self.settings)

    def _targets(self, state: WorldState, flocks: SubFlocks) -> Floats:
        s, flock, gcm = self.settings, flocks.sheep[0], flocks.centers[0]
        to_goal = state.goal_pos - gcm
        push = min(max(s.gain * math.hypot(*to_goal), s.min_push), 1.0)
        arc = max(arc_width(push, state.n_shepherds), s.min_arc)
        far = np.hypot(*(flock - gcm).T)
        radius = min(max((far.mean() + far.max()) / 2 + s.standoff, s.min_radius), s.max_radius)
        places = arc_places(gcm, float(bearing_of(to_goal)), float(radius), arc, state.n_shepherds)
        slots = np.unwrap(bearing_of(places - gcm))
        return np.asarray(places[in_order(bearing_of(state.shepherd_pos - gcm), slots)])


@settings
class PiersonGains(Settings):
    """Gains of the reconstructed variant: ours; k, l and K are of the size that re-implementations use."""

    gain: float = Field(default=0.25, gt=0)
    """k [1/s]."""
    ahead: float = Field(default=2.0, ge=0)
    """l, from the centroid to the point that is drawn to the goal [m]."""
    radius: float = Field(default=9.5, gt=0)
    """r [m]: just within the 10 m at which shepherds are felt; at 8 m and less the closed ring scatters the flock."""
    tracking: float = Field(default=1.0, gt=0)
    """K [1/s]."""


class PiersonReconstructed:
    """The method as published as far as it is known: one centroid, fixed radius, no terminal rule.

    v is taken over the sheep's speed, within 0 (a ring) and 1 (all on one spot).

    Args:
        settings: its gains.
    """

    lidar = None

    def __init__(self, settings: PiersonGains | None = None) -> None:
        self.settings = settings or PiersonGains()

    def reset(self, rng: np.random.Generator) -> None:
        """Nothing to remember."""

    def to_dict(self) -> dict[str, Any]:
        """Its parameters."""
        return self.settings.to_dict()

    def act(self, observation: NDArray[np.float32], state: WorldState) -> NDArray[np.float64]:
        """(P, 2)."""
        s = self.settings
        gcm = centroid(state.sheep_pos)
        to_goal = state.goal_pos - gcm
        v = s.gain * (math.hypot(*to_goal) - s.ahead)
        push = min(max(v / float(state.sheep_max_speed.max()), 0.0), 1.0)
        arc = arc_width(push, state.n_shepherds)
        places = arc_places(gcm, float(bearing_of(to_goal)), s.radius, arc, state.n_shepherds)
        return limited(s.tracking * (places - state.shepherd_pos) / state.shepherd_max_speed[:, None])


@njit(cache=True)
def arc_width(push, n_shepherds):  # type: ignore[no-untyped-def]
    """Delta in [0, Delta_0] for which sum_j cos Delta_j = m v_hat, by bisection; 0 for a lone shepherd [rad].

    Args:
        push: v_hat in [0, 1].
        n_shepherds: m.
    """
    m = n_shepherds
    if m < 2:
        return 0.0
    low, high = 0.0, math.pi / m  # x = Delta / (2 m - 2)
    for _ in range(HALVINGS):
        x = (low + high) / 2
        if math.sin(m * x) > push * m * math.sin(x):
            low = x
        else:
            high = x
    return (low + high) * (m - 1)


def arc_places(center: Floats, phi: float, radius: float, arc: float, n_shepherds: int) -> Floats:
    """(m, 2) places d_1 .. d_m on the arc behind a flock that is to move along phi [m].

    Args:
        center: (2,) s [m].
        phi: where the flock is to go [rad].
        radius: r [m].
        arc: Delta [rad].
        n_shepherds: m.
    """
    m = n_shepherds
    delta = arc * (2 * np.arange(1, m + 1) - m - 1) / max(2 * m - 2, 1)
    return np.asarray(center + radius * heading(phi + np.pi + delta))
