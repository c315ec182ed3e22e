"""Run controllers and measure what they achieve: `run_episode`, `evaluate`."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from shepherd_phys.scenario import SUCCESS_FRACTION
from shepherd_phys.settings import kind_of
from shepherd_phys.state import WorldState
from shepherd_phys.workers import explain

from .base import Controller
from .learned import Policy

LABELS = ("controller", "n_flocks", "cohesion", "n_shepherds", "n_sheep", "scenario")
"""Columns that say what was run: together they name a point of an experiment."""
METRICS = (
    "in_goal_end",
    "ever_in_goal",
    "mean_occupancy",
    "path_length",
    "time_to_95",
    "reached_95",
    "success",
    "collisions",
    "steps",
)
"""Columns that say what came of it; see `run_episode`."""
COLUMNS = (*LABELS, "seed", *METRICS, "settings_hash", "version")
"""Columns of ``episodes.csv``."""


class ControllerError(ValueError):
    """A controller is not one, or did what no controller may; the message names it."""


class Env(Protocol):
    """What a running episode needs of an env (`shepherd_phys.envs.ShepherdingEnv` has it)."""

    @property
    def state(self) -> WorldState:
        """The latest state of the world."""
        ...

    @property
    def user_rng(self) -> np.random.Generator:
        """The stream for the controller, seeded by reset."""
        ...

    def reset(self, *, seed: int | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode."""
        ...

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """One control step."""
        ...


def trial_seed(root: int, trial: int) -> int:
    """The seed of trial ``trial`` (0-based) of a campaign with root seed ``root``, in [0, 2^63).

    It depends on these two alone, so every controller and every point meets the same episodes. The range is the largest
    that SQLite's whole numbers hold: seeds of a million trials are all different.
    """
    return int(np.random.SeedSequence([root, trial]).generate_state(1, np.uint64)[0]) >> 1


def run_episode(controller: Controller, env: Env, seed: int) -> dict[str, Any]:
    """Run one episode to its end and measure it, from the world's states alone.

    Args:
        controller: who moves the shepherds.
        env: made with the controller's ``lidar``.
        seed: the env's, taken as it is.

    Returns:
        a row: ``seed``; in percent of the sheep ``in_goal_end`` (in at the end), ``ever_in_goal`` and
        ``mean_occupancy`` (in, averaged over the control steps made); ``path_length``, the summed displacement over
        the whole episode, mean over shepherds [m]; ``time_to_95``, the first time that at least 95 % are in, the
        episode's length where never [s], and ``reached_95``, which of the two; ``success``, at least 95 % in at the
        end; ``collisions``, new contacts of a shepherd with an obstacle or another shepherd, over the team; ``steps``,
        control steps made.

    Raises:
        ControllerError: an action has another shape than (P, 2) or holds a NaN or an infinity.
    """
    world = getattr(env, "unwrapped", env)  # wrappers of Gymnasium hide what they do not know
    observation, _ = env.reset(seed=seed)
    controller.reset(world.user_rng)
    state: WorldState = world.state
    n_sheep = state.n_sheep
    time_to_95 = state.time if _in_goal(state) >= SUCCESS_FRACTION else None
    occupied = 0
    over = False
    while not over:
        action = checked_action(controller.act(observation, state), controller, state)
        observation, _, terminated, truncated, _ = env.step(action)
        over = bool(terminated) or bool(truncated)
        state = world.state
        occupied += int(np.count_nonzero(state.sheep_in_goal))
        if time_to_95 is None and _in_goal(state) >= SUCCESS_FRACTION:
            time_to_95 = state.time
    return {
        "seed": int(seed),
        "in_goal_end": 100.0 * _in_goal(state),
        "ever_in_goal": 100.0 * (int(np.count_nonzero(state.sheep_arrived)) / n_sheep),
        "mean_occupancy": 100.0 * occupied / (n_sheep * state.step),
        "path_length": float(state.shepherd_path.mean()) if state.n_shepherds else 0.0,
        "time_to_95": float(state.time if time_to_95 is None else time_to_95),
        "reached_95": time_to_95 is not None,
        "success": _in_goal(state) >= SUCCESS_FRACTION,
        "collisions": int(state.collisions),
        "steps": int(state.step),
    }


def evaluate(controller: Controller, make_env: Callable[..., Env], seeds: Iterable[int]) -> list[dict[str, Any]]:
    """Run one episode a seed, in this process.

    Args:
        controller: any object (or class without arguments) with the members of `Controller`; a user's own is enough.
        make_env: called once as ``make_env(lidar=controller.lidar, rewards={})``, so that nothing is computed which
            the controller does not need: ``functools.partial(ShepherdingEnv, scenario)``.
        seeds: of the env, taken as they are.

    Returns:
        the rows of `run_episode`, each with the ``controller``'s name.

    Raises:
        ControllerError: it is no controller, or acts as none may.
    """
    controller = checked_controller(controller)
    env = make_env(lidar=controller.lidar, rewards={})
    try:
        name = name_of(controller)
        return [{"controller": name, **run_episode(controller, env, seed)} for seed in seeds]
    finally:
        close = getattr(env, "close", None)
        if close is not None:
            close()


def checked_controller(controller: Any) -> Controller:
    """A controller, made from its class where that is given.

    Raises:
        ControllerError: it lacks something.
    """
    if inspect.isclass(controller):
        try:
            controller = controller()
        except TypeError as error:
            name = name_of(controller)
            raise ControllerError(f"controller {name}: cannot be made without arguments ({error})") from None
        except Exception as error:
            raise ControllerError(f"controller {name_of(controller)}: cannot be made: {explain(error)}") from None
    lacking = [name for name in ("reset", "act") if not callable(getattr(controller, name, None))]
    if not hasattr(controller, "lidar"):
        lacking.insert(0, "lidar")
    if lacking:
        raise ControllerError(
            f"controller {name_of(controller)}: lacks {' and '.join(lacking)}; a controller has "
            "lidar (None if it needs no scan), reset(rng) and act(observation, state)"
        )
    made: Controller = controller
    return made


def parameters_of(controller: Any) -> dict[str, Any]:
    """The controller's parameters as plain data, where it tells them (``to_dict`` or ``settings``)."""
    for name in ("to_dict", "settings"):
        tell = getattr(controller, name, None)
        if callable(tell):
            return dict(tell())
    return {}


def name_of(controller: Any) -> str:
    """A policy's name; the class's name of any other."""
    if isinstance(controller, Policy):
        return controller.name
    return str((controller if inspect.isclass(controller) else type(controller)).__qualname__)


def _in_goal(state: WorldState) -> float:
    return int(np.count_nonzero(state.sheep_in_goal)) / state.n_sheep


def checked_action(action: Any, controller: Controller, state: WorldState) -> NDArray[np.float64]:
    """The action as (P, 2) finite numbers.

    Raises:
        ControllerError: it is not; a class of a user's own is named as ``module:Name``.
    """
    kind = kind_of(controller)
    where = f"controller {kind if ':' in kind else name_of(controller)}, step {state.step}"
    try:
        numbers = np.asarray(action, dtype=np.float64)
    except (TypeError, ValueError):
        raise ControllerError(f"{where}: the action must be an array of numbers (given: {action!r})") from None
    if numbers.shape != (state.n_shepherds, 2):
        raise ControllerError(f"{where}: the action must have the shape {(state.n_shepherds, 2)}, has {numbers.shape}")
    if not np.isfinite(numbers).all():
        raise ControllerError(f"{where}: the action holds a NaN or an infinity: {numbers.tolist()}")
    return numbers
