"""Imperfect sensing and acting: what goes wrong between a scan and an observation, and between a wish and a motion.

Rewards and metrics never see any of it: they read the state and the scan as they are.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from shepherd_phys.lidar import Lidar, Scan
from shepherd_phys.observation import Proximities, encode
from shepherd_phys.settings import Settings, settings
from shepherd_phys.state import Floats, frozen


@settings
class Imperfections(Settings):
    """How imperfect sensors and drives are; all off by default. A scenario has them as ``imperfections``."""

    lost_beams: float = Field(default=0.0, ge=0, le=1)
    """q: probability with which a beam of a channel reads nothing [1], drawn anew for each at every control step."""
    range_noise: float = Field(default=0.0, ge=0, le=10)
    """Standard deviation of a reading's Gaussian error over the reading [1]; what comes of it is clipped to
    [0, range]."""
    scan_delay: int = Field(default=0, ge=0, le=1000)
    """k [control steps]: the newest scan that is observed is that of k steps ago, until then the first."""
    action_noise: float = Field(default=0.0, ge=0, le=10)
    """Standard deviation of the Gaussian error of either number of an action [top speeds]; added before the action is
    clipped to the unit disc."""


class Sight:
    """What the shepherds are given of the scans of one episode.

    Args:
        lidar: what they observe.
        imperfections: of their sensors; None: they have none.
        rng: the stream of what goes wrong. Draws are those of the observed channels alone, at every scan
            ``random((channels, P, beams))`` if beams are lost, then as many ``standard_normal`` if ranges are noisy: so
            observations do not depend on what else was scanned for rewards.
    """

    def __init__(self, lidar: Lidar, imperfections: Imperfections | None, rng: np.random.Generator) -> None:
        self._lidar = lidar
        self._settings = imperfections or Imperfections()
        self._rng = rng
        self._late: deque[Proximities] = deque(maxlen=self._settings.scan_delay + 1)

    def frame(self, scan: Scan) -> Proximities:
        """The frame (P, channels, beams) of this control step; call it once a step.

        Args:
            scan: as the world gives it.
        """
        seen = self._settings
        if seen.lost_beams > 0 or seen.range_noise > 0:
            scan = self._disturbed(scan)
        frame = encode(scan, self._lidar)
        if not seen.scan_delay:
            return frame
        self._late.append(frame)
        while len(self._late) <= seen.scan_delay:
            self._late.append(frame)
        return self._late[0]

    def _disturbed(self, scan: Scan) -> Scan:
        """The observed channels with beams lost and ranges noisy."""
        lidar, seen = self._lidar, self._settings
        nothing = np.full(scan.ranges.shape[1:], np.inf)
        ranges = np.array([scan[name] if name in scan.names else nothing for name in lidar.channels])
        if seen.lost_beams > 0:
            ranges[self._rng.random(ranges.shape) < seen.lost_beams] = np.inf
        if seen.range_noise > 0:
            factor = 1.0 + seen.range_noise * self._rng.standard_normal(ranges.shape)
            full = np.array([lidar.goal_range if name == "goal" else lidar.range for name in lidar.channels])
            lit = np.isfinite(ranges)
            noisy = np.clip(np.where(lit, ranges, 0.0) * factor, 0.0, full[:, None, None])
            ranges = np.where(lit, noisy, np.inf)
        return Scan(lidar.channels, frozen(ranges))


def disturbed(action: Floats, noise: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """An action (P, 2) with Gaussian errors of standard deviation ``noise``, both in top speeds."""
    return action + noise * rng.standard_normal(action.shape)
