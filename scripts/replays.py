"""Replays of a campaign: each episode leaves a file, whichever worker runs it and whenever it was run."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from shepherd_phys import __version__, campaign
from shepherd_phys.campaign import Failure, Ledger, Task
from shepherd_phys.controllers.recording import recorded
from shepherd_phys.envs.shepherding import ShepherdingEnv
from shepherd_phys.replay_file import save_replay
from shepherd_phys.settings import SettingsError

from .points import Point, find_controller

SUFFIX = ".npz"
"""A replay is a file that ``numpy.load`` opens."""
REWARDS = "wild"
"""Scheme whose terms are kept. It is computed beside the episode and changes nothing in it."""
MAX_NAME = 100
"""Characters of a name, without hash and seed: file systems allow 255 bytes."""


def file_name(point: Point, settings_hash: str, trial: int, seed: int) -> str:
    """What an episode's replay is called: controller and point in words, part of the hash of all settings, trial, seed.

    The trial says which one it is among those of a root seed; the seed keeps the trials of other root seeds apart.
    """
    labels = point.labels
    words = [Path(labels["controller"]).stem if labels["controller"].endswith(".json") else labels["controller"]]
    words += [Path(labels["scenario"]).stem, f"{labels['n_flocks']}-flocks"]
    words += [] if labels["cohesion"] is None else [f"n{labels['cohesion']}"]
    words += [f"{labels['n_shepherds']}-shepherds", f"{labels['n_sheep']}-sheep"]
    name = "_".join(re.sub(r"[^A-Za-z0-9.-]+", "-", word).strip(".-") or "own" for word in words)
    return f"{name[:MAX_NAME]}_{settings_hash[:8]}_trial-{trial}_seed-{seed}{SUFFIX}"


def recorded_episode(folder: str, trials: Mapping[int, int], point: Point, seed: int) -> dict[str, Any]:
    """Run one episode of a point and leave its replay in ``folder``: the work of a campaign; see `points.episode`.

    ``trials`` has the trial's number of each seed.
    """
    controller = find_controller(point.controller)
    env = ShepherdingEnv(point.scenario, rewards=REWARDS, lidar=controller.lidar)
    try:
        row, replay = recorded(controller, env, seed, name=point.controller, scenario_name=point.scenario_name)
    finally:
        env.close()
    save_replay(replay, Path(folder, file_name(point, point.settings_hash(), trials[seed], seed)))
    return row


def open_folder(folder: Path) -> Path:
    """The folder, made if missing, by its whole path: workers of a cluster may stand elsewhere.

    Raises:
        SettingsError: it cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise SettingsError(f"save-replay: {folder}: cannot be made or written ({error.strerror})") from None
    return folder.absolute()


def missing(folder: Path, trials: Mapping[int, int], tasks: Sequence[Task]) -> list[Task]:
    """The tasks that have no replay in the folder; ``trials`` has the trial's number of each seed."""

    def place(task: Task) -> Path:
        return folder / file_name(task.spec, task.settings_hash, trials[task.seed], task.seed)

    return [task for task in tasks if not place(task).exists()]


def record_again(
    folder: Path, trials: Mapping[int, int], tasks: Sequence[Task], rows: Sequence[dict[str, Any]], **how: Any
) -> list[Failure]:
    """Run episodes that have a row already once more, for their replays; the rows stay as they are.

    Args:
        folder: where replays go.
        trials: the trial's number of each seed.
        tasks: to be run.
        rows: that they have.
        how: further arguments of `campaign.run`: workers, timeout, report.

    Returns:
        those that left no replay, or one of another result than the row that is kept.

    Raises:
        CampaignError: no worker can be started or reached.
    """
    if not tasks:
        return []
    with tempfile.TemporaryDirectory(prefix="shepherd-phys-") as scratch, Ledger(scratch, __version__) as ledger:
        outcome = campaign.run(tasks, partial(recorded_episode, str(folder), trials), ledger=ledger, **how)
    failures = list(outcome.failures)
    for task, row, kept in zip(tasks, outcome.rows, rows, strict=True):
        if row is not None and row != kept:
            failures.append(Failure(task, "played again, the episode came to another row than the one that is kept", 1))
    return failures
