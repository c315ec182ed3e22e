"""What an episode has come to: its measures, and how long success has held."""

from __future__ import annotations

from typing import Any

import numpy as np

from shepherd_phys.scenario import SUCCESS_FRACTION
from shepherd_phys.state import WorldState

SUCCESS_SECONDS = 5.0
"""With ``terminate_on_success`` an episode ends when success has held for so long [s]."""


def measures(state: WorldState) -> dict[str, Any]:
    """Scalars of every ``info``: fractions of the sheep, mean path length [m], new contacts, success now."""
    n = state.n_sheep
    in_goal = int(np.count_nonzero(state.sheep_in_goal)) / n
    return {
        "in_goal": in_goal,
        "ever_in_goal": int(np.count_nonzero(state.sheep_arrived)) / n,
        "path_length": sum(state.shepherd_path.tolist()) / max(state.n_shepherds, 1),
        "collisions": state.collisions,
        "is_success": in_goal >= SUCCESS_FRACTION,
    }


class HeldSuccess:
    """Asked at every control step: whether the episode has been a success for long enough."""

    def __init__(self) -> None:
        self._since: float | None = None

    def reset(self) -> None:
        """A new episode."""
        self._since = None

    def __call__(self, state: WorldState, success: bool) -> bool:
        """Whether success, which is or is not there now, has held for `SUCCESS_SECONDS`."""
        if not success:
            self._since = None
            return False
        if self._since is None:
            self._since = state.time
        return state.time - self._since >= SUCCESS_SECONDS - 1e-9
