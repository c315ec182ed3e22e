"""How sheep wish to move: flock models, from the state of the world to desired velocities."""

from __future__ import annotations

import math
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numba import njit
from numpy.typing import NDArray
from pydantic import Field

from shepherd_phys.avoidance import Avoidance
from shepherd_phys.cells import build, one_cell
from shepherd_phys.neighbours import GRID_FROM, surroundings
from shepherd_phys.settings import Settings, settings
from shepherd_phys.state import WorldState

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@runtime_checkable
class FlockModel(Protocol):
    """What the world needs of a flock model. A user writes a class with this method, or a function like it."""

    def velocities(self, state: WorldState, rng: np.random.Generator) -> Floats:
        """Desired velocities of all sheep, from one snapshot.

        Args:
            state: the world now.
            rng: the flock's own stream of random numbers.

        Returns:
            (N, 2) [m/s]. The direction of a row becomes the sheep's heading; a row of zeros stands still and
            keeps the heading.
        """
        ...


@settings
class Strombom(Settings):
    """The sheep of Strömbom et al. 2014 (J. R. Soc. Interface 11:20140719), equations 4.1-4.3.

    A sheep is threatened while any shepherd is within r_s. Otherwise it grazes: it stands still, and with probability
    p makes one step in a uniformly random direction. A threatened sheep at A_i with heading H_i moves along

        H' = h H_i + c C_i + rho_a R_a + rho_s R_s + e eps + O_i,    v* = speed H' / |H'|

    where C_i points to the mean position of the n nearest others, R_a is the normalised sum of unit(A_i - A_j) over
    sheep nearer than r_a, R_s that of unit(A_i - S_j) over shepherds within r_s, and eps a unit vector in a
    uniformly random direction. O_i, which the 2014 sheep do not have, is the push away from obstacles (`Avoidance`), no
    unit vector. A term of length 0 is 0; if H' is 0 the heading stays.

    Weights, p: the 2014 values. The paper's many shepherds are summed as here by its successors.
    """

    inertia: float = Field(default=0.5, ge=0)
    """h, weight of the last heading [1] (2014)."""
    attraction: float = Field(default=1.05, ge=0)
    """c, weight of C [1] (2014)."""
    repulsion: float = Field(default=2.0, ge=0)
    """rho_a, weight of R_a [1] (2014)."""
    flight: float = Field(default=1.0, ge=0)
    """rho_s, weight of R_s [1] (2014)."""
    noise: float = Field(default=0.3, ge=0)
    """e, weight of eps [1] (2014)."""
    detection_radius: float = Field(default=10.0, ge=0)
    """r_s [m], the influence radius I of the perception-based rewards paper (65 m in 2014, at another scale)."""
    sheep_distance: float = Field(default=0.4, ge=0)
    """r_a [m], inferred from packing the goal (2 m in 2014, at another scale)."""
    n_neighbours: int = Field(default=40, ge=1)
    """n [sheep], at any distance, clipped to N - 1; the perception-based rewards paper varies it from 10 to 85."""
    graze_probability: float = Field(default=0.05, ge=0, le=1)
    """p per control step [1] (2014)."""
    avoidance: Avoidance = Avoidance()
    """O, how a threatened sheep feels obstacles."""

    def velocities(self, state: WorldState, rng: np.random.Generator) -> Floats:
        """Desired velocities (N, 2) [m/s].

        Draws ``rng.random((N, 2))`` whatever happens: column 0 is below p where a grazing sheep moves, column 1
        is the angle over 2 pi of its step, or of eps.
        """
        draws = rng.random((state.n_sheep, 2))
        return desired(
            state.sheep_pos, state.sheep_heading, state.sheep_max_speed, state.shepherd_pos, draws,
            self.inertia, self.attraction, self.repulsion, self.flight, self.noise,
            self.detection_radius, self.sheep_distance, self.n_neighbours, self.graze_probability,
            state.n_sheep >= GRID_FROM, self.avoidance.pushes(state),
        )  # fmt: skip


@settings
class Reynolds(Settings):
    """The boids of Reynolds 1987 (Computer Graphics 21:25-34) with flight from shepherds.

    A sheep with no shepherd within r_s grazes as in `Strombom`. Otherwise, with V_i its velocity over its top speed,

        v = w_v V_i + w_c C_i + w_a L_i + w_s R_a + w_f R_s + O_i,    v* = top speed * v / max(1, |v|)

    where C_i points to the mean position, L_i along the mean velocity of the others within r, R_a is the normalised sum
    of unit(A_i - A_j) over those nearer than r_a, and R_s that of unit(A_i - S_j) over shepherds within r_s; O_i is
    the push of `Avoidance` away from obstacles. A term of length 0 is 0. There is no noise: all that is random is
    grazing.

    The 1987 paper names the three urges and gives no numbers; weights and radii are inferred for this scale. Neighbours
    are those within a distance, whatever their number: there is no n to set.
    """

    inertia: float = Field(default=0.5, ge=0)
    """w_v, weight of the velocity that it has [1]."""
    cohesion: float = Field(default=1.0, ge=0)
    """w_c, weight of C: flock centering [1]."""
    alignment: float = Field(default=1.0, ge=0)
    """w_a, weight of L: velocity matching [1]."""
    separation: float = Field(default=1.5, ge=0)
    """w_s, weight of R_a: collision avoidance [1]."""
    flight: float = Field(default=2.0, ge=0)
    """w_f, weight of R_s [1]; of the shepherding, not in 1987."""
    neighbour_radius: float = Field(default=5.0, ge=0)
    """r [m]: sheep within it are neighbours."""
    sheep_distance: float = Field(default=0.4, ge=0)
    """r_a [m], as in `Strombom`."""
    detection_radius: float = Field(default=10.0, ge=0)
    """r_s [m], as in `Strombom`."""
    graze_probability: float = Field(default=0.05, ge=0, le=1)
    """p per control step [1], as in `Strombom`."""
    avoidance: Avoidance = Avoidance()
    """O, as in `Strombom`."""

    def velocities(self, state: WorldState, rng: np.random.Generator) -> Floats:
        """Desired velocities (N, 2) [m/s].

        Draws ``rng.random((N, 2))`` whatever happens, and uses it for grazing as `Strombom` does.
        """
        draws = rng.random((state.n_sheep, 2))
        return boids(
            state.sheep_pos, state.sheep_vel, state.sheep_max_speed, state.shepherd_pos, draws,
            self.inertia, self.cohesion, self.alignment, self.separation, self.flight,
            self.neighbour_radius, self.sheep_distance, self.detection_radius, self.graze_probability,
            state.n_sheep >= GRID_FROM, self.avoidance.pushes(state),
        )  # fmt: skip


FLOCKS: dict[str, type[Any]] = {"Strombom": Strombom, "Reynolds": Reynolds}
"""The library's flock models by name, for files and the command line."""


@njit(cache=True)
def _unit(x: float, y: float) -> tuple[float, float]:
    length = math.sqrt(x * x + y * y)
    return (x / length, y / length) if length > 0.0 else (0.0, 0.0)


@njit(cache=True)
def flight(sheep: Floats, shepherds: Floats, r_s: float) -> tuple[NDArray[np.bool_], Floats]:
    """Who is threatened, and whither it flees.

    Args:
        sheep: (N, 2) A_i [m].
        shepherds: (P, 2) S_j [m].
        r_s: [m].

    Returns:
        (N,) whether a shepherd is within r_s, |A_i - S_j| <= r_s; (N, 2) sum over those of unit(A_i - S_j).
    """
    threatened = np.zeros(len(sheep), np.bool_)
    away = np.zeros((len(sheep), 2))
    for i in range(len(sheep)):
        for j in range(len(shepherds)):
            dx, dy = sheep[i, 0] - shepherds[j, 0], sheep[i, 1] - shepherds[j, 1]
            if dx * dx + dy * dy <= r_s * r_s:
                threatened[i] = True
                ux, uy = _unit(dx, dy)
                away[i, 0] += ux
                away[i, 1] += uy
    return threatened, away


@njit(cache=True)
def grazing(threatened: NDArray[np.bool_], speed: Floats, draws: Floats, p: float) -> Floats:
    """What sheep wish that nobody threatens: to stand still, but for a step now and then.

    Args:
        threatened: (N,) these are left at zeros.
        speed: (N,) [m/s].
        draws: (N, 2) uniform in [0, 1): whether to step, and the angle over 2 pi.
        p: probability of a step.

    Returns:
        (N, 2) v* [m/s].
    """
    velocity = np.zeros((len(speed), 2))
    for i in range(len(speed)):
        if not threatened[i] and draws[i, 0] < p:
            angle = 2.0 * math.pi * draws[i, 1]
            velocity[i, 0], velocity[i, 1] = speed[i] * math.cos(angle), speed[i] * math.sin(angle)
    return velocity


@njit(cache=True)
def desired(
    sheep: Floats, heading: Floats, speed: Floats, shepherds: Floats, draws: Floats,
    h: float, c: float, rho_a: float, rho_s: float, e: float, r_s: float, r_a: float, n: int, p: float,
    use_grid: bool, pushed: Floats,
) -> Floats:  # fmt: skip
    """The rule of `Strombom`, for the whole flock at once.

    Args:
        sheep: (N, 2) A_i [m].
        heading: (N, 2) H_i, unit vectors.
        speed: (N,) [m/s].
        shepherds: (P, 2) S_j [m].
        draws: (N, 2) uniform in [0, 1): whether to step while grazing, and the angle over 2 pi.
        h: inertia.
        c: attraction.
        rho_a: repulsion.
        rho_s: flight.
        e: noise.
        r_s: detection radius [m].
        r_a: sheep distance [m].
        n: neighbours.
        p: probability of a step while grazing.
        use_grid: find neighbours through a grid; the same neighbours, faster for large flocks.
        pushed: (N, 2) O_i; (0, 2) where there are no obstacles.

    Returns:
        (N, 2) v* [m/s].
    """
    threatened, away = flight(sheep, shepherds, r_s)
    velocity = grazing(threatened, speed, draws, p)
    if not threatened.any():
        return velocity
    towards, apart = surroundings(sheep, threatened, n, r_a, use_grid, np.empty((0, 0), np.int64))
    for i in range(len(sheep)):
        if not threatened[i]:
            continue
        angle = 2.0 * math.pi * draws[i, 1]
        cx, cy = _unit(towards[i, 0], towards[i, 1])
        ax, ay = _unit(apart[i, 0], apart[i, 1])
        sx, sy = _unit(away[i, 0], away[i, 1])
        x = h * heading[i, 0] + c * cx + rho_a * ax + rho_s * sx + e * math.cos(angle)
        y = h * heading[i, 1] + c * cy + rho_a * ay + rho_s * sy + e * math.sin(angle)
        if len(pushed) > 0:
            x += pushed[i, 0]
            y += pushed[i, 1]
        if x == 0.0 and y == 0.0:
            x, y = heading[i, 0], heading[i, 1]
        ux, uy = _unit(x, y)
        velocity[i, 0], velocity[i, 1] = speed[i] * ux, speed[i] * uy
    return velocity


# Reassociation is allowed in this one sum alone, as in `shepherd_phys.neighbours`.
@njit(cache=True, fastmath={"reassoc", "nsz"})
def _within(
    x: Floats, y: Floats, vx: Floats, vy: Floats, xi: float, yi: float, limit: float, own: int
) -> tuple[float, float, float, float]:
    """Sums of A_j - A_i and of the velocities over the points but ``own`` that are no further than sqrt(limit)."""
    sx, sy, su, sv = 0.0, 0.0, 0.0, 0.0
    for j in range(len(x)):
        dx, dy = x[j] - xi, y[j] - yi
        near = (dx * dx + dy * dy <= limit) & (j != own)
        sx += dx if near else 0.0
        sy += dy if near else 0.0
        su += vx[j] if near else 0.0
        sv += vy[j] if near else 0.0
    return sx, sy, su, sv


@njit(cache=True)
def _apart(x: Floats, y: Floats, xi: float, yi: float, limit: float, hits: Ints) -> tuple[float, float]:
    """Sum of unit(A_i - A_j) over the points nearer than sqrt(limit); ``hits`` is scratch."""
    count = 0
    for j in range(len(x)):  # without a branch: which points are near is unpredictable
        dx, dy = xi - x[j], yi - y[j]
        hits[count] = j
        count += 1 if dx * dx + dy * dy < limit else 0
    ax, ay = 0.0, 0.0
    for k in range(count):
        ux, uy = _unit(xi - x[hits[k]], yi - y[hits[k]])
        ax += ux
        ay += uy
    return ax, ay


@njit(cache=True)
def boids(
    sheep: Floats, moving: Floats, speed: Floats, shepherds: Floats, draws: Floats,
    w_v: float, w_c: float, w_a: float, w_s: float, w_f: float, r: float, r_a: float, r_s: float, p: float,
    use_grid: bool, pushed: Floats,
) -> Floats:  # fmt: skip
    """The rule of `Reynolds`, for the whole flock at once.

    Args:
        sheep: (N, 2) A_i [m].
        moving: (N, 2) velocities as the bodies have them [m/s].
        speed: (N,) top speeds [m/s].
        shepherds: (P, 2) S_j [m].
        draws: (N, 2) uniform in [0, 1): whether to step while grazing, and the angle over 2 pi.
        w_v: weight of the velocity.
        w_c: weight of cohesion.
        w_a: weight of alignment.
        w_s: weight of separation.
        w_f: weight of flight.
        r: neighbour radius [m].
        r_a: sheep distance [m].
        r_s: detection radius [m].
        p: probability of a step while grazing.
        use_grid: look through cells as large as the larger of the two radii, not through all sheep.
        pushed: (N, 2) O_i; (0, 2) where there are no obstacles.

    Returns:
        (N, 2) v* [m/s].
    """
    threatened, away = flight(sheep, shepherds, r_s)
    velocity = grazing(threatened, speed, draws, p)
    if not threatened.any():
        return velocity
    cells = build(sheep, max(r, r_a)) if use_grid else one_cell(sheep)
    rows, columns, start, order, x, y = cells.rows, cells.columns, cells.start, cells.order, cells.x, cells.y
    vx, vy, hits = moving[order, 0], moving[order, 1], np.empty(len(sheep) + 1, np.int64)
    for cell in range(rows * columns):
        row, column = cell // columns, cell % columns
        for own in range(start[cell], start[cell + 1]):
            i = order[own]
            if not threatened[i]:
                continue
            towards_x, towards_y, along_x, along_y, apart_x, apart_y = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for near in range(max(row - 1, 0), min(row + 2, rows)):
                first = start[near * columns + max(column - 1, 0)]
                end = start[near * columns + min(column + 1, columns - 1) + 1]
                px, py = x[first:end], y[first:end]
                sx, sy, su, sv = _within(px, py, vx[first:end], vy[first:end], x[own], y[own], r * r, own - first)
                ax, ay = _apart(px, py, x[own], y[own], r_a * r_a, hits)
                towards_x, towards_y, along_x, along_y = towards_x + sx, towards_y + sy, along_x + su, along_y + sv
                apart_x, apart_y = apart_x + ax, apart_y + ay
            cx, cy = _unit(towards_x, towards_y)
            lx, ly = _unit(along_x, along_y)
            sx, sy = _unit(apart_x, apart_y)
            fx, fy = _unit(away[i, 0], away[i, 1])
            ux = w_v * vx[own] / speed[i] + w_c * cx + w_a * lx + w_s * sx + w_f * fx
            uy = w_v * vy[own] / speed[i] + w_c * cy + w_a * ly + w_s * sy + w_f * fy
            if len(pushed) > 0:
                ux += pushed[i, 0]
                uy += pushed[i, 1]
            scale = speed[i] / max(1.0, math.sqrt(ux * ux + uy * uy))
            velocity[i, 0], velocity[i, 1] = scale * ux, scale * uy
    return velocity
