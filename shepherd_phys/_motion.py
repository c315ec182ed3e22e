"""Kernels of a control step: what is wanted as commands, commands as forces, what was read as a state."""

from __future__ import annotations

import math

import numba


@numba.njit(cache=True)
def command_shepherds(action, speed, command):  # type: ignore[no-untyped-def]
    """Write the wanted velocities of the shepherds, the last rows of ``command``; whether the action is finite."""
    n = len(command) - len(action)
    for k in range(len(action)):
        x, y = action[k, 0], action[k, 1]
        length = math.hypot(x, y)
        if not math.isfinite(x) or not math.isfinite(y):
            return False
        if length > 1.0:  # a length that overflowed to infinity still has a direction
            scale = max(abs(x), abs(y))
            x, y = x / scale, y / scale
            length = math.hypot(x, y)
            x, y = x / length, y / length
        command[n + k, 0] = x * speed[k]
        command[n + k, 1] = y * speed[k]
    return True


@numba.njit(cache=True)
def command_sheep(wanted, command):  # type: ignore[no-untyped-def]
    """Write the wanted velocities of the sheep, the first rows of ``command``; whether they are finite."""
    for i in range(len(wanted)):
        if not math.isfinite(wanted[i, 0]) or not math.isfinite(wanted[i, 1]):
            return False
        command[i, 0] = wanted[i, 0]
        command[i, 1] = wanted[i, 1]
    return True


@numba.njit(cache=True)
def servo(rows, command, mass, moment, h, limit, spin_limit, spins, force):  # type: ignore[no-untyped-def]
    """F = m (v* - v) / h, no longer than m times the limit; torque likewise."""
    v = 3 if spins else 2
    for i in range(len(command)):
        dx, dy = command[i, 0] - rows[i, v], command[i, 1] - rows[i, v + 1]
        big = max(abs(dx), abs(dy))
        if big > limit * h:  # scaled before it is squared: a huge wish must not overflow
            dx, dy = dx / big, dy / big
            length = math.sqrt(dx * dx + dy * dy)
            dx, dy = dx / length * (limit * h), dy / length * (limit * h)
        else:
            length = math.sqrt(dx * dx + dy * dy)
            if length > limit * h:
                dx, dy = dx / length * (limit * h), dy / length * (limit * h)
        force[i, 0] = mass[i] * dx / h
        force[i, 1] = mass[i] * dy / h
        if spins:
            turn = min(max((command[i, 2] - rows[i, 5]) / h, -spin_limit), spin_limit)
            force[i, 2] = turn * moment[i] if math.isfinite(moment[i]) else 0.0


@numba.njit(cache=True)
def measure(  # type: ignore[no-untyped-def]
    rows, command, heading, arrived, previous, path, goal, goal_radius,
    vectors, numbers, flags, poses,
):  # fmt: skip
    """Write what a state holds; whether all is finite.

    ``vectors`` (3 N + 2 P, 2) positions, velocities and headings of the sheep, positions and velocities of the
    shepherds; ``numbers`` (N + 2 P,) distances of the sheep to the goal, angles and ways walked of the shepherds;
    ``flags`` (2, N) in the goal now and ever; ``poses`` of all.
    """
    n, p = len(heading), len(previous)
    pos, vel, turned = vectors[:n], vectors[n : 2 * n], vectors[2 * n : 3 * n]
    at, at_vel = vectors[3 * n : 3 * n + p], vectors[3 * n + p :]
    distance, angle, walked = numbers[:n], numbers[n : n + p], numbers[n + p :]
    inside, ever = flags[0], flags[1]
    spins = rows.shape[1] == 6
    v = 3 if spins else 2
    total = 0.0  # not finite as soon as one of its terms is not
    for i in range(n):
        x, y = rows[i, 0], rows[i, 1]
        pos[i, 0], pos[i, 1] = x, y
        poses[i, 0], poses[i, 1], poses[i, 2] = x, y, rows[i, 2] if spins else 0.0
        vel[i, 0], vel[i, 1] = rows[i, v], rows[i, v + 1]
        total += x + y + vel[i, 0] + vel[i, 1]
        # a sheep that stands still keeps the direction that it was last commanded
        cx, cy = command[i, 0], command[i, 1]
        length = math.sqrt(cx * cx + cy * cy)
        turned[i, 0] = cx / length if length > 0.0 else heading[i, 0]
        turned[i, 1] = cy / length if length > 0.0 else heading[i, 1]
        d = math.sqrt((x - goal[0]) ** 2 + (y - goal[1]) ** 2)
        inside[i] = d <= goal_radius
        distance[i] = max(d - goal_radius, 0.0)
        ever[i] = arrived[i] or inside[i]
    for k in range(p):
        x, y = rows[n + k, 0], rows[n + k, 1]
        at[k, 0], at[k, 1] = x, y
        at_vel[k, 0], at_vel[k, 1] = rows[n + k, v], rows[n + k, v + 1]
        angle[k] = rows[n + k, 2] if spins else 0.0
        poses[n + k, 0], poses[n + k, 1], poses[n + k, 2] = x, y, angle[k]
        total += x + y + at_vel[k, 0] + at_vel[k, 1] + angle[k]
        walked[k] = path[k] + math.sqrt((x - previous[k, 0]) ** 2 + (y - previous[k, 1]) ** 2)
    return math.isfinite(total)
