"""What of a scan a policy observes: proximities, the last frames of them, rolled, grouped and laid out; and back.

One set of functions for the training envs and for deployed policies.
"""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shepherd_phys import _frames
from shepherd_phys.lidar import Lidar, Scan, beam_directions
from shepherd_phys.state import frozen

Proximities = NDArray[np.float32]


def encode(scan: Scan, lidar: Lidar) -> Proximities:
    """Proximities 1 - d/range of a scan, (P, n_channels, beams) float32: 0 where nothing is seen.

    A channel of ``lidar`` that the scan does not have reads nothing.
    """
    channels = lidar.channels
    ranges = scan.ranges
    if scan.names[: len(channels)] != channels:
        nothing = np.full(ranges.shape[1:], np.inf)
        ranges = frozen(np.array([scan[name] if name in scan.names else nothing for name in channels]))
    goal_row = channels.index("goal") if "goal" in channels else -1
    encoded: Proximities = np.empty((ranges.shape[1], len(channels), ranges.shape[2]), np.float32)
    _frames.proximities(ranges, goal_row, lidar.range, lidar.goal_range, encoded)
    return encoded


class Stack:
    """The last frames of a team, as many as an observation looks back; the first one after a reset fills it."""

    def __init__(self, lidar: Lidar) -> None:
        self._lidar = lidar
        self._frames: deque[Proximities] = deque(maxlen=lidar.look_back)

    def reset(self) -> None:
        """Forget all frames."""
        self._frames.clear()

    def push(self, frame: Proximities) -> None:
        """Take the frame of this control step, (P, channels, beams); it is kept, not copied."""
        self._frames.append(frame)
        while len(self._frames) < (self._frames.maxlen or 0):
            self._frames.append(frame)

    def frames(self) -> Proximities:
        """Return the frames of an observation, newest last: a fresh (P, stack, channels, beams) float32."""
        chosen = list(self._frames)[:: self._lidar.stack_stride]
        n_shepherds, n_channels, beams = chosen[0].shape
        return np.concatenate(chosen, axis=1).reshape(n_shepherds, len(chosen), n_channels, beams)

    def offset(self, last: NDArray[np.int64]) -> NDArray[np.int64]:
        """The beam offsets (P,) that `observe` would answer, in the goal frame, without an observation."""
        offsets, lidar = last.copy(), self._lidar
        goal = lidar.channels.index("goal")
        _frames.goal_offsets(self._frames[-1], goal, beam_directions(lidar.beams), offsets)
        return offsets

    def observe(self, offset: NDArray[np.int64]) -> tuple[Proximities, NDArray[np.int64]]:
        """`observe` of the frames, without its copy."""
        lidar = self._lidar
        if lidar.frame == "world" and lidar.sectors is None and lidar.layout == "rows":  # the default, made cheap
            return np.concatenate(list(self._frames)[:: lidar.stack_stride], axis=1), offset
        return _observe(self.frames(), offset, self._lidar)


def observe(stack: Proximities, offset: NDArray[np.int64], lidar: Lidar) -> tuple[Proximities, NDArray[np.int64]]:
    """Turn stacked frames of all beams into observations. The training env and the deployed policy both call it.

    In this order: roll by the newest frame (frame "goal"), keep the nearest return of each sector, lay out.

    Args:
        stack: (..., stack, channels, beams) proximities in the world frame, newest frame last.
        offset: (...) last beam offset of each shepherd, 0 at reset.
        lidar: the settings.

    Returns:
        a fresh (..., stack x channels, columns), or (..., channels x columns, 1, stack) for the layout "paper", and
        the beam offset now (...): observed column 0 points at world beam ``offset``. It stays where no goal beam is
        lit, or more than half of them (then the shepherd stands inside; obstacles so near to the goal that they cut
        half of the way out hide that from it).

    Raises:
        ValueError: there are not as many offsets as shepherds.
    """
    offset = np.asarray(offset, np.int64)
    if offset.shape != stack.shape[:-3]:
        raise ValueError(f"offset: needs the shape {stack.shape[:-3]}, has {offset.shape}")
    rolled = lidar.frame == "goal" or (lidar.sectors or lidar.beams) != lidar.beams  # then it is fresh anyway
    frames = np.ascontiguousarray(stack, np.float32) if rolled else np.array(stack, np.float32)
    return _observe(frames, offset, lidar)


def _observe(stack: Proximities, offset: NDArray[np.int64], lidar: Lidar) -> tuple[Proximities, NDArray[np.int64]]:
    """As `observe`; the observation may be a view of ``stack``."""
    *teams, n_frames, n_channels, beams = stack.shape
    columns = lidar.sectors or beams
    rows: Any = stack
    if lidar.frame == "goal" or columns != beams:
        rows = stack.reshape(-1, n_frames * n_channels, beams)
        grouped = np.empty((*rows.shape[:2], columns), np.float32)
        if lidar.frame == "goal":
            offset = offset.copy()
            goal = (n_frames - 1) * n_channels + lidar.channels.index("goal")
            _frames.goal_sectors(rows, goal, beam_directions(beams), offset.reshape(-1), grouped)
        else:
            _frames.rolled_sectors(rows, np.zeros(len(rows), np.int64), grouped)
        rows = grouped
    if lidar.layout == "paper":
        framed = rows.reshape(*teams, n_frames, n_channels * columns)
        return np.ascontiguousarray(np.moveaxis(framed, -2, -1))[..., None, :], offset
    return rows.reshape(*teams, n_frames * n_channels, columns), offset


def turn(action: NDArray[Any], offset: NDArray[np.int64], beams: int) -> NDArray[Any]:
    """Vectors (P, 2) of the observed frame in world axes: turned by the angle of beam ``offset`` (P,).

    Raises:
        ValueError: there are not as many of one as of the other, or they have other shapes.
    """
    if offset.ndim != 1 or action.shape != (len(offset), 2):
        raise ValueError(f"action: needs the shape (P, 2) with offsets (P,), has {action.shape} with {offset.shape}")
    angle = (2.0 * np.pi / beams) * offset
    turned = np.empty(action.shape, np.result_type(action.dtype, np.float32))
    _frames.turned(action, np.cos(angle), np.sin(angle), turned)
    return turned
