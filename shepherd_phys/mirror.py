"""Seeing the world in a mirror: the task is the same for a shepherd when left and right change places.

Learning breaks that symmetry. A policy goes round the goal in one sense, whichever way is shorter. Where every shepherd
sees its nearest sheep on the same side of its way to the goal when an episode begins, it need not learn both senses,
and goes the shorter way. One function for the training env and for the deployed policy, as with the goal frame.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from shepherd_phys.lidar import Lidar
from shepherd_phys.settings import SettingsError

Side = Literal["never", "left", "right"]
"""Shepherds with their nearest sheep on this side when an episode begins see the world in a mirror until its end."""
ACTION = np.array([1.0, -1.0], np.float32)
"""An action's two numbers, along the way to the goal and across, as a mirror shows them."""


def check(side: Side, lidar: Lidar) -> None:
    """Find out whether somebody with this lidar can see in a mirror.

    Raises:
        SettingsError: the goal is not straight ahead, or no sheep are seen.
    """
    if side != "never" and (lidar.frame != "goal" or "sheep" not in lidar.channels or lidar.layout != "rows"):
        raise SettingsError(
            f"mirror: needs the frame 'goal', the channel of sheep and the layout 'rows' (given: {lidar})"
        )


def mirrored(side: Side, observation: NDArray[np.float32], lidar: Lidar) -> NDArray[np.bool_]:
    """Who (P,) is to see in a mirror, by the first observation (P, R, C) of an episode; with a tie the left wins."""
    columns = observation.shape[2]
    newest = len(lidar.channels) * (lidar.stack - 1)
    nearest = observation[:, newest + lidar.channels.index("sheep")].argmax(axis=1)  # 0, straight ahead: none is seen
    if side == "left":
        return np.asarray((nearest > 0) & (2 * nearest < columns))
    return np.asarray((2 * nearest > columns) & (side == "right"))


def seen(observation: NDArray[np.float32], who: NDArray[np.bool_]) -> NDArray[Any]:
    """Observations (P, R, C), those of ``who`` (P,) with columns the other way round.

    Column 0 stays where it is. Of sectors it is half a beam off its own mirror image.
    """
    shown = observation.copy()
    if who.any():
        shown[who, :, 1:] = observation[who, :, :0:-1]
    return shown


def meant(actions: NDArray[Any], who: NDArray[np.bool_]) -> NDArray[Any]:
    """What actions (P, 2) in the goal frame mean of those who (P,) see in a mirror; it is its own reverse."""
    return np.where(who[:, None], actions * ACTION, actions)
