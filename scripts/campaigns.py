"""A command's campaign: its ledger, workers and bar at hand, and the ways in which the command ends."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from shepherd_phys import __version__, campaign, neighbours
from shepherd_phys.campaign import CampaignError, Failure, Hire, Ledger, Outcome, Task
from shepherd_phys.controllers.evaluation import ControllerError
from shepherd_phys.envs.shepherding import ShepherdingEnv
from shepherd_phys.scenario import SCENARIOS
from shepherd_phys.settings import SettingsError
from shepherd_phys.workers import Work

from .command import fail, progress_bar
from .points import episode, place


class Opened(NamedTuple):
    """A campaign that can run."""

    ledger: Ledger
    how: dict[str, Any]
    """Further arguments of `campaign.run`: workers, timeout, report."""

    def run(self, todo: Sequence[Task], work: Work = episode) -> Outcome:
        """Run what the ledger lacks of the tasks.

        Raises:
            CampaignError: the ledger cannot be written, or no worker can be started or reached.
        """
        return campaign.run(todo, work, ledger=self.ledger, **self.how)


@contextlib.contextmanager
def opened(
    folder: Path, todo: Sequence[Task], *, workers: int | Hire, timeout: float, gather: Sequence[Path] = ()
) -> Iterator[Opened]:
    """A campaign in a folder, when what is still to be run of it has been rehearsed; with a bar on standard error.

    Args:
        folder: of its ledger, an earlier run's perhaps.
        todo: its tasks.
        workers: processes of this machine, or a cluster (`command.workforce`).
        timeout: of an episode [s].
        gather: folders of other campaigns, whose episodes are taken over.

    Raises:
        SettingsError: no world can be placed for a point; no folder has been made then. Or the folder is not to be had,
            or nothing can be gathered from a source.
    """
    with progress_bar() as report:
        try:
            ledger = _ready(folder, todo, gather)
        except CampaignError as error:
            raise SettingsError(str(error)) from None
        with ledger:
            yield Opened(ledger, {"workers": workers, "timeout": timeout, "report": report})


def _ready(folder: Path, todo: Sequence[Task], sources: Sequence[Path]) -> Ledger:
    """The folder's ledger with what other folders have, when what is still to be run has been rehearsed."""
    taken = campaign.gathered(sources, __version__, todo)
    if sources:
        print(f"gathered {len(taken)} of {len(todo)} episodes", file=sys.stderr)
    is_new = not (folder / campaign.LEDGER).exists()
    if is_new:
        _rehearse([task for task in todo if task.key not in taken])
    ledger = Ledger(folder, __version__)
    try:
        ledger.take(taken)
        if not is_new:
            kept = ledger.rows(task.settings_hash for task in todo)
            _rehearse([task for task in todo if task.key not in kept])
    except BaseException:
        ledger.close()
        raise
    return ledger


def _rehearse(todo: Sequence[Task]) -> None:
    """Find out once, and not by every episode's failing, what can be known before; compile before workers start.

    Raises:
        SettingsError: no world can be placed for a point (on three of its seeds; one may be bad luck).
    """
    if not todo:
        return
    if not _are_compiled():
        print("compiling the kernels, once; about a minute", file=sys.stderr, flush=True)
    env = ShepherdingEnv(SCENARIOS["small"], rewards={}, lidar=None)
    env.reset(seed=0)
    env.step(np.zeros((env.scenario.n_shepherds, 2)))  # compiled code is kept on disk: workers find it there
    seeds: dict[str, list[int]] = {}
    for task in todo:
        seeds.setdefault(task.settings_hash, []).append(task.seed)
    for task in {task.settings_hash: task for task in todo}.values():
        place(task.spec, seeds[task.settings_hash][:3])


def _are_compiled() -> bool:
    """Whether numba has kept compiled code where it keeps ours; also where it is told to compile nothing."""
    stats = getattr(neighbours.surroundings, "stats", None)
    return stats is None or any(Path(stats.cache_path).glob("neighbours.*.nbi"))


def lost(failures: Iterable[Failure]) -> list[str]:
    """Which episodes have no result, and why."""
    return [f"no result in {failure.attempts} attempts: {failure}" for failure in failures]


def ended(prog: str, folder: Path, command: Callable[[], int]) -> int:
    """Run a command; the exit status: its own, 2 for a mistake of the user, 1 if it cannot go on, 130 for Ctrl-C.

    Args:
        prog: whose name stands before the line that says why.
        folder: where the command keeps what was done.
        command: what is to be run.
    """
    try:
        return command()
    except (SettingsError, ControllerError) as error:
        return fail(prog, error, 2)
    except CampaignError as error:
        return fail(prog, error, 1)
    except KeyboardInterrupt:
        kept = f"; what was done is kept in {folder}: the same command continues" if folder.exists() else ""
        return fail(prog, f"stopped{kept}", 130)
