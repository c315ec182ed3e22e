"""``shepherd-phys plot KIND ..``: figures of results, of an episode, of where everybody walks, of training runs."""

from __future__ import annotations

import contextlib
import importlib.util
import itertools
import json
import math
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from shepherd_phys.campaign import CampaignError, write_bytes
from shepherd_phys.controllers.evaluation import METRICS, ControllerError, trial_seed
from shepherd_phys.controllers.summary import summarise
from shepherd_phys.learning.folder import CURVE, PRESET, VALIDATION
from shepherd_phys.learning.folder import MEASURES as VALIDATED
from shepherd_phys.settings import SettingsError, read_toml
from shepherd_phys.workers import explain

from .command import at_least, cpu_count, fail, flag, parsed, progress_bar
from .curves import MEASURES as TRAINED
from .curves import binned, read_rows
from .episode_tables import VARIED, chosen, once, read_episodes
from .points import LEAST as WORLD_LEAST
from .points import WorldFlags, place

PROG = "shepherd-phys plot"
ENDINGS = ("png", "svg", "pdf")
ROOT_SEED = 20_000
"""Of the trials that `evaluate` reports."""
MOST_POINTS = 60
"""Of a learning curve, unless it is asked for more: rollouts differ much from one to the next."""

TITLES = {
    "in_goal_end": "sheep in the goal at the end, %",
    "ever_in_goal": "sheep that were ever in the goal, %",
    "mean_occupancy": "sheep in the goal, mean over time, %",
    "path_length": "path of a shepherd, m (mean of the team)",
    "time_to_95": "time until 95 percent are in, s",
    "reached_95": "share of episodes with 95 percent ever in",
    "success": "share of episodes with 95 percent in at the end",
    "collisions": "collisions in an episode",
    "steps": "control steps of an episode",
    "episode_reward": "reward of an episode",
}
"""Of measures; those in percent have the sign."""


@dataclass(frozen=True)
class Measures:
    """Draw measures with 95 % bootstrap intervals against what was varied, one line a controller.

    Reads episodes.csv, as evaluate and reproduce write it.
    """

    tables: Annotated[tyro.conf.Positional[tuple[Path, ...]], flag("FILE|DIR ..", "")] = ()
    """episodes.csv, or folders that hold it; several are put together."""
    measure: Annotated[tuple[str, ...], flag("NAME ..")] = ("in_goal_end", "path_length")
    """Columns, a panel each."""
    against: Annotated[str | None, flag("|".join(VARIED), "what varies in the table")] = None
    """What stands along the x axis."""
    controllers: Annotated[tuple[str, ...], flag("NAME ..", "all")] = ()
    """Only these, in this order."""
    flocks: Annotated[tuple[int, ...], flag("K ..", "all")] = ()
    """Only rows with these numbers of flocks."""
    cohesion: Annotated[tuple[int, ...], flag("N ..", "all")] = ()
    """Only rows with these numbers of attracting neighbours."""
    shepherds: Annotated[tuple[int, ...], flag("M ..", "all")] = ()
    """Only rows with these numbers of shepherds."""
    sheep: Annotated[tuple[int, ...], flag("N ..", "all")] = ()
    """Only rows with these numbers of sheep."""
    scenario: Annotated[str | None, flag("NAME", "all")] = None
    """Only rows of this scenario."""
    out: Annotated[Path, flag("FILE")] = Path("measures.png")
    """Where to; its ending says what: png, svg or pdf."""


@dataclass(frozen=True)
class Trajectories(WorldFlags):
    """Run one episode and draw its paths, overlaid."""

    controller: Annotated[str, flag("NAME|FILE|module:Name")] = "collie"
    """Who moves the shepherds."""
    seed: Annotated[int, flag("S", "that of evaluate's first trial")] = trial_seed(ROOT_SEED, 0)
    """Of the episode, as the column seed of episodes.csv tells it."""
    color: Annotated[Literal["time", "flock"], flag("time|flock")] = "time"
    """What the colour of a sheep's path tells: when, or in which flock the sheep began."""
    out: Annotated[Path, flag("FILE")] = Path("trajectories.png")
    """Where to; its ending says what: png, svg or pdf."""


@dataclass(frozen=True)
class Heatmap(WorldFlags):
    """Run many episodes and map how long shepherds or sheep stand where, seen from the goal."""

    controllers: Annotated[tuple[str, ...], flag("NAME ..")] = ("collie",)
    """Controllers by name, or module:Name of your own; a map each."""
    who: Annotated[Literal["shepherds", "sheep"], flag("shepherds|sheep")] = "shepherds"
    """Whose places are mapped."""
    frame: Annotated[Literal["flock", "world"], flag("flock|world")] = "flock"
    """flock: each episode is turned so that the sheep's centroid starts straight up from the goal."""
    trials: Annotated[int, flag("T")] = 20
    """Episodes a controller, on the seeds of evaluate's first trials."""
    seed: Annotated[int, flag("S")] = ROOT_SEED
    """Root seed, as in evaluate."""
    workers: Annotated[int, flag("W")] = cpu_count()
    """Worker processes; the map does not depend on it."""
    out: Annotated[Path, flag("FILE")] = Path("heatmap.png")
    """Where to; its ending says what: png, svg or pdf."""


@dataclass(frozen=True)
class Learning:
    """Draw the learning curves of training runs, those of one recipe as their mean.

    Runs are of one recipe if their preset.toml differ in seed and budget alone. A mean ends where its shortest run
    does; a band reaches from the least run to the most.
    """

    runs: Annotated[tyro.conf.Positional[tuple[Path, ...]], flag("DIR ..", "")] = ()
    """Folders of train."""
    training: Annotated[tuple[str, ...], flag("NAME ..")] = ("episode_reward",)
    """Measures of the episodes of training, a panel each."""
    validation: Annotated[tuple[str, ...], flag("NAME ..", "in_goal_end, where there are any")] = ()
    """Measures of validations, means over their points, a panel each."""
    smooth: Annotated[int | None, flag("K", f"such that no curve has more than {MOST_POINTS} points")] = None
    """Neighbouring rollouts that are averaged into one point of a curve of training."""
    out: Annotated[Path, flag("FILE")] = Path("learning.png")
    """Where to; its ending says what: png, svg or pdf."""


LEAST = {**WORLD_LEAST, "seed": 0}


def main(argv: Sequence[str]) -> int:
    """Run the command; the exit status: 0, 1 if something failed on the way, 2 for a mistake of the user."""
    kind = argv[0] if argv else ""
    if kind in ("-h", "--help"):
        print(usage())
        return 0
    if kind not in PLOTS:
        problem = f"{kind!r} is unknown" if kind else "say what to draw"
        return fail(PROG, f"{problem}; there are {', '.join(PLOTS)} (see {PROG} --help)", 2)
    cls, draw = PLOTS[kind]
    prog = f"{PROG} {kind}"
    try:
        options, _ = parsed(cls, prog, argv[1:])
        ready(options.out)
        with contextlib.redirect_stdout(sys.stderr):  # a user's classes may print wherever they are touched
            content = draw(options)
        write_bytes(options.out, content)
    except (SettingsError, ControllerError) as error:
        return fail(prog, error, 2)
    except CampaignError as error:
        return fail(prog, error, 1)
    print(options.out)
    return 0


def usage() -> str:
    """What ``--help`` prints."""
    width = max(map(len, PLOTS))
    kinds = "\n".join(f"  {name:<{width}}  {(cls.__doc__ or '').splitlines()[0]}" for name, (cls, _) in PLOTS.items())
    return (
        f"usage: {PROG} KIND [OPTIONS]\n\nDraw a figure as PNG, SVG or PDF.\n\nkinds:\n{kinds}\n\n"
        f"'{PROG} KIND --help' lists its options."
    )


def ready(out: Path) -> None:
    """Find out before anything is run whether a figure can be drawn and written.

    Raises:
        SettingsError: matplotlib is missing; the file's ending or folder cannot be.
    """
    if out.suffix.removeprefix(".") not in ENDINGS:
        raise SettingsError(f"out: {out} must end in {', '.join(f'.{ending}' for ending in ENDINGS)}")
    if not out.parent.is_dir():
        raise SettingsError(f"out: there is no folder {out.parent}")
    if out.is_dir() or not os.access(out.parent, os.W_OK):
        raise SettingsError(f"out: {out} cannot be written")
    if importlib.util.find_spec("matplotlib") is None:
        raise SettingsError("matplotlib is missing (pip install 'shepherd-phys[analysis]')")


def kind_of_file(out: Path) -> str:
    """Of `ENDINGS`."""
    return out.suffix.removeprefix(".")


def draw_measures(options: Measures) -> bytes:
    """The figure of measures.

    Raises:
        SettingsError: a table is none, nothing is left of it, or more varies than is drawn.
    """
    from . import figures

    known(options.measure, METRICS, "measure")
    rows = [row for path in options.tables for row in read_episodes(path)]
    if not options.tables:
        raise SettingsError("needs episodes.csv, or a folder that holds it")
    numbers = {name: getattr(options, name) for name in VARIED}
    rows = once(chosen(rows, numbers, options.controllers, options.scenario))
    varying = [name for name, (label, _) in VARIED.items() if len({row[label] for row in rows}) > 1]
    if options.against is not None and options.against not in VARIED:
        raise SettingsError(f"against: {options.against!r} is unknown; there are {', '.join(VARIED)}")
    against = options.against or (varying[0] if varying else "flocks")
    more = [name for name in varying if name != against]
    if more:
        there = sorted({row[VARIED[more[0]][0]] for row in rows}, key=lambda n: (n is not None, n))
        said = "" if options.against else f", or say which to draw --against ({', '.join(varying)})"
        raise SettingsError(f"{more[0]} varies, too ({', '.join(map(str, there))}): choose one with --{more[0]}{said}")
    if len(scenarios := {row["scenario"] for row in rows}) > 1:
        raise SettingsError(f"scenario varies ({', '.join(sorted(scenarios))}): choose one with --scenario")
    label, title = VARIED[against]
    if any(row[label] is None for row in rows):
        raise SettingsError(f"against: there are rows without {against}, of another flock model")
    summary = summarise(rows, options.measure)
    order = options.controllers or tuple(figures.STYLES)
    summary.sort(key=lambda row: order.index(row["controller"]) if row["controller"] in order else len(order))
    fixed = figures.told({name: rows[0][name] for name, _ in VARIED.values() if name != label})
    trials = sorted({row["trials"] for row in summary})
    many = str(trials[0]) if len(trials) == 1 else f"{trials[0]} to {trials[-1]}"
    about = f"{rows[0]['scenario']}: {fixed}; {many} trials a point; mean with 95 % bootstrap interval"
    metrics = {name: TITLES[name] for name in options.measure}
    return figures.draw_measures(summary, label, title, metrics, about, kind_of_file(options.out))


def draw_trajectories(options: Trajectories) -> bytes:
    """The figure of one episode.

    Raises:
        SettingsError: something is unknown or impossible.
        ControllerError: the controller is none, or acts as none may.
        CampaignError: something in the episode failed.
    """
    from . import path_figures
    from .paths import walks

    at_least({name: getattr(options, name) for name in LEAST}, LEAST)
    point = options.point(options.controller)
    place(point, [options.seed])
    try:
        walk = walks(point, options.seed)
    except (SettingsError, ControllerError):
        raise
    except Exception as error:  # of a user's own class
        raise CampaignError(f"{point}, seed {options.seed}: {explain(error)}") from None
    return path_figures.draw_trajectories(point, options.seed, walk, options.color, kind_of_file(options.out))


def draw_heatmap(options: Heatmap) -> bytes:
    """The map of many episodes.

    Raises:
        SettingsError: something is unknown or impossible.
        ControllerError: a controller is none.
        CampaignError: an episode has no result.
    """
    from . import path_figures
    from .paths import maps

    at_least({"trials": options.trials, "workers": options.workers}, {"trials": 1, "workers": 1})
    at_least({name: getattr(options, name) for name in LEAST}, LEAST)
    found = [options.point(name) for name in dict.fromkeys(options.controllers)]
    if not found:
        raise SettingsError("controllers: needs at least one value")
    seeds = [trial_seed(options.seed, trial) for trial in range(options.trials)]
    for point in found:
        place(point, seeds[:3])
    with progress_bar() as report:
        made = maps(found, seeds, options.who, options.frame, workers=options.workers, report=report)
    about = path_figures.words(found[0])
    return path_figures.draw_maps(
        made, options.who, options.frame, about, found[0].scenario.goal_radius, kind_of_file(options.out)
    )


def draw_learning(options: Learning) -> bytes:
    """The learning curves of runs.

    Raises:
        SettingsError: a folder holds no run, or nothing that can be drawn.
    """
    from . import learning_figures

    known(options.training, TRAINED, "training")
    known(options.validation, VALIDATED, "validation")
    if not options.runs:
        raise SettingsError("needs folders of training runs")
    at_least({"smooth": options.smooth}, {"smooth": 1})
    curves: list[dict[str, Any]] = []
    validations: list[dict[str, Any]] = []
    found = [
        (label, run, read_rows(run / CURVE, ("rollout", "shepherd_steps", *TRAINED)))
        for label, run in recipes(options.runs)
    ]
    width = options.smooth or math.ceil(max(len(rows) for _, _, rows in found) / MOST_POINTS)
    for k, (recipe, run, rows) in enumerate(found):
        labels = {"recipe": recipe, "reward": "", "seed": k}
        whole = [row for row in binned(rows, width) if row["rollout"] <= rows[-1]["rollout"]]
        curves += [{**labels, **row} for row in whole]
        if (run / VALIDATION).exists():
            columns = ("checkpoint", "shepherd_steps", *VALIDATED)
            validations += [{**labels, **row} for row in read_rows(run / VALIDATION, columns)]
    if options.validation and not validations:
        raise SettingsError("validation: none of the runs has been validated")
    checked = options.validation or (("in_goal_end",) if validations else ())
    if not curves:
        raise SettingsError("the runs have not ended a rollout yet")
    trained, validated = ({name: TITLES[name] for name in measures} for measures in (options.training, checked))
    return learning_figures.draw_runs(curves, validations, trained, validated, kind_of_file(options.out))


def recipes(runs: Sequence[Path]) -> list[tuple[str, Path]]:
    """Each run with the name of its recipe: what the names of its runs' folders have in common.

    Raises:
        SettingsError: a folder holds no run.
    """
    alike: dict[str, list[Path]] = {}
    for run in dict.fromkeys(runs):
        if not (run / PRESET).exists():
            raise SettingsError(f"{run}: holds no training run (no {PRESET})")
        settings = {name: value for name, value in read_toml(run / PRESET).items() if name not in ("seed", "budget")}
        alike.setdefault(json.dumps(settings, sort_keys=True, default=str), []).append(run)
    names = []
    for group in alike.values():
        folders = [run.resolve().name for run in group]
        letters = itertools.takewhile(lambda found: len(set(found)) == 1, zip(*folders, strict=False))
        shared = "".join(found[0] for found in letters).rstrip("0123456789-_.")
        names.append(folders[0] if len(folders) == 1 else shared or " and ".join(folders))
    if len(set(names)) < len(names):  # of two recipes the folders are called alike
        names = [", ".join(map(str, group)) for group in alike.values()]
    return [(name, run) for name, group in zip(names, alike.values(), strict=True) for run in group]


def known(given: Sequence[str], there: Sequence[str], name: str) -> None:
    """Refuse measures that are none.

    Raises:
        SettingsError: names it and what there is.
    """
    for measure in given:
        if measure not in there:
            raise SettingsError(f"{name}: {measure!r} is unknown; there are {', '.join(there)}")


PLOTS: Mapping[str, tuple[Any, Callable[[Any], bytes]]] = {
    "measures": (Measures, draw_measures),
    "trajectories": (Trajectories, draw_trajectories),
    "heatmap": (Heatmap, draw_heatmap),
    "learning": (Learning, draw_learning),
}
"""What can be drawn: its command line and how."""
