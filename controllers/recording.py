"""`record`: run an episode and keep all of it."""

from __future__ import annotations

from typing import Any

from shepherd_phys.replay import Env, Recorder, Replay

from .base import Controller
from .evaluation import checked_controller, name_of, parameters_of, run_episode


def record(controller: Controller, env: Env, seed: int) -> Replay:
    """Run one episode to its end and keep every state, action and reward term of it.

    Args:
        controller: any object (or class without arguments) with the members of `Controller`.
        env: made with the controller's ``lidar``; its reward scheme is what is kept of rewards.
        seed: the env's, taken as it is.

    Raises:
        ControllerError: it is no controller, or acts as none may.
    """
    return recorded(controller, env, seed)[1]


def recorded(
    controller: Controller, env: Env, seed: int, *, name: str | None = None, scenario_name: str = ""
) -> tuple[dict[str, Any], Replay]:
    """The row of `run_episode`, and the replay, as `record` makes it.

    Args:
        controller: as for `record`.
        env: as for `record`.
        seed: as for `record`.
        name: of the controller, where it was asked for by another than its class's.
        scenario_name: by which the scenario was asked for.
    """
    controller = checked_controller(controller)
    recorder = Recorder(env)
    row = run_episode(controller, recorder, seed)
    return row, recorder.replay(name or name_of(controller), parameters_of(controller), scenario_name)
