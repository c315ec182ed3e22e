"""The floor that every controller must beat: random and idle."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from shepherd_phys.settings import SettingsError
from shepherd_phys.state import WorldState


class Idle:
    """Stands still."""

    lidar = None

    def reset(self, rng: np.random.Generator) -> None:
        """Nothing to remember."""

    def act(self, observation: NDArray[np.float32], state: WorldState) -> NDArray[np.float64]:
        """All zeros."""
        return np.zeros((state.n_shepherds, 2))

    def to_dict(self) -> dict[str, Any]:
        """No parameters."""
        return {}


class Random:
    """Walks at a velocity drawn uniformly from the disc of allowed ones, kept for a while, then drawn anew.

    Args:
        hold: control steps for which a velocity is kept.
    """

    lidar = None

    def __init__(self, hold: int = 10) -> None:
        if not isinstance(hold, int) or hold < 1:
            raise SettingsError(f"Random.hold: must be a whole number of at least 1 (given: {hold!r})")
        self.hold = hold

    def reset(self, rng: np.random.Generator) -> None:
        """Take the episode's generator."""
        self._rng = rng
        self._action: NDArray[np.float64] | None = None

    def act(self, observation: NDArray[np.float32], state: WorldState) -> NDArray[np.float64]:
        """(P, 2)."""
        if self._action is None or state.step % self.hold == 0:
            angle = self._rng.uniform(0.0, 2 * np.pi, state.n_shepherds)
            size = np.sqrt(self._rng.random(state.n_shepherds))  # uniform over the disc's area
            self._action = size[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        return self._action.copy()

    def to_dict(self) -> dict[str, Any]:
        """Its parameters."""
        return {"hold": self.hold}
