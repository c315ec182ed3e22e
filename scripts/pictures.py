"""The picture that ``evaluate`` leaves beside its tables: how the first trial ended."""

from __future__ import annotations

import importlib.util
import sys
from functools import partial
from pathlib import Path

from shepherd_phys.campaign import Ledger, Task
from shepherd_phys.controllers.evaluation import run_episode
from shepherd_phys.envs.shepherding import ShepherdingEnv
from shepherd_phys.workers import explain

from .points import Point, find_controller

PICTURE = "episode.png"
PICTURE_SIZE = (900, 900)
"""[px]."""


def picture(task: Task, ledger: Ledger, prog: str) -> list[Path]:
    """Draw how a task's episode ended beside the ledger, unless that picture is there; its path, if there is one.

    What is in the way is said on standard error, in the name of ``prog``.
    """
    path = ledger.folder / PICTURE
    if importlib.util.find_spec("pygame") is None:
        print(f"{prog}: no {PICTURE}: pygame-ce is missing (pip install 'shepherd-phys[render]')", file=sys.stderr)
        return []
    drawn = f"{task.settings_hash} {task.seed}"
    if path.exists() and ledger.note(PICTURE) == drawn:
        return [path]
    try:
        draw_episode(task.spec, task.seed, path)
    except Exception as error:  # the tables do not hang on a picture
        print(f"{prog}: no {PICTURE}: {explain(error)}", file=sys.stderr)
        return []
    ledger.leave_note(PICTURE, drawn)
    return [path]


def draw_episode(point: Point, seed: int, path: Path) -> None:
    """Run an episode again in this process and draw its end, with trails and where the sheep began."""
    from shepherd_phys.render import save_png

    controller = find_controller(point.controller)
    make_env = partial(
        ShepherdingEnv,
        point.scenario,
        render_mode="rgb_array",
        render_size=PICTURE_SIZE,
        trail_steps=point.scenario.n_steps,
    )
    env = make_env(rewards={}, lidar=controller.lidar)
    run_episode(controller, env, seed)
    drawn = env.render()
    env.close()
    if drawn is not None:
        save_png(drawn, path)
