"""``shepherd-phys tune``: search the lengths of a heuristic team, on tuning seeds alone.

Candidates meet in rounds: half of them proposed by Optuna's TPE sampler, half near the best so far (at first: the
values set by hand, the settings' defaults), with a few lengths moved by a step or two. In a round all play the same
few episodes, the better half plays on, and so forth. Every episode is kept in a ledger, and everything else follows
from the seed: a search that was stopped continues with the same command.
"""

from __future__ import annotations

import contextlib
import importlib.util
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from shepherd_phys import __version__, campaign
from shepherd_phys.campaign import CampaignError, Ledger, settings_hash
from shepherd_phys.controllers import elfiqi, occlusion, pierson, strombom
from shepherd_phys.controllers.evaluation import evaluate, trial_seed
from shepherd_phys.controllers.formation import Team, TeamSettings
from shepherd_phys.envs.shepherding import ShepherdingEnv
from shepherd_phys.scenario import SCENARIOS, Scenario
from shepherd_phys.settings import SettingsError, write_toml

from .command import at_least, cpu_count, fail, flag, parsed, progress_bar

PROG = "shepherd-phys tune"

Space = dict[str, tuple[float, float, float]]
"""Of each length that is searched: least, largest, what a step to a value beside it is."""

TEAM: Space = {
    "stop_distance": (0.0, 3.0, 0.5),
    "link": (2.0, 5.0, 0.5),
    "let_go": (1.0, 5.0, 0.5),
    "ring": (9.5, 12.0, 0.25),
    "ring_out": (10.5, 13.0, 0.25),
    "crumb": (0.0, 1.0, 0.1),
    "loyalty": (0.0, 8.0, 1.0),
    "berth": (6.0, 12.0, 0.5),
}
"""What all teams share (`TeamSettings`)."""

TEAMS: dict[str, tuple[Callable[[Any], Team], TeamSettings, Space]] = {
    "strombom": (
        strombom.StrombomTeam,
        strombom.TUNED,
        {
            "collect_standoff": (2.0, 7.0, 0.5),
            "drive_standoff": (5.0, 10.0, 0.5),
            "flock_radius": (2.0, 8.0, 0.5),
            "v_angle": (0.2, 1.2, 0.1),
        },
    ),
    "pierson": (
        pierson.Pierson,
        pierson.TUNED,
        {
            "gain": (0.05, 0.5, 0.05),
            "min_push": (0.3, 1.0, 0.1),
            "min_arc": (0.4, 2.0, 0.2),
            "standoff": (3.0, 9.0, 0.5),
            "min_radius": (4.0, 9.0, 0.5),
            "max_radius": (6.0, 10.0, 0.5),
        },
    ),
    "elfiqi": (
        elfiqi.Elfiqi,
        elfiqi.TUNED,
        {
            "flock_radius": (2.0, 8.0, 0.5),
            "collect_standoff": (2.0, 7.0, 0.5),
            "drive_distance": (5.0, 10.0, 0.5),
        },
    ),
    "occlusion": (
        occlusion.Occlusion,
        occlusion.TUNED,
        {"approach": (1.0, 7.0, 0.5), "circle": (4.0, 10.0, 0.5), "min_radius": (0.5, 3.0, 0.5)},
    ),
}
"""Who can be tuned: how the team is made, the settings that it has, what is searched beside `TEAM`."""

POINTS = ((1, 40, 3), (2, 40, 3), (3, 40, 3), (5, 40, 3), (2, 10, 3), (2, 40, 1), (2, 40, 2), (2, 40, 6))
"""Where every candidate plays: flocks, neighbours n, shepherds."""
ROUND = (1, 1, 2, 4)
"""Further trials a point in each heat of a round; the better half goes on to the next."""
CONFIRM = 8
"""Trials a point, met by nobody before, on which the finalists are compared."""
FINALISTS = 2
"""How many of the best meet the values set by hand."""
SECOND = 0.1
"""What a second until 95 % are in costs, in percent of the sheep in the goal at the end."""
TUNING_SEEDS = 10_000
"""Root seeds below this are for tuning."""

MOVED, STEPS = 3, 2
"""So many lengths of the best are moved for a candidate near it, by at most so many steps."""
DECIMALS = 2
"""Values are rounded to what a person would write."""

Candidate = dict[str, float]


@dataclass(frozen=True)
class Tune:
    """Search the lengths of a tuned heuristic team on tuning seeds, and write down the best and how it was found.

    Writes NAME.toml into the folder --out: the values, the score of the best and of the values set by hand on seeds
    that the search has not seen, the command and the version.
    """

    controller: Annotated[str, flag("|".join(TEAMS))] = "strombom"
    """The team."""
    rounds: Annotated[int, flag("R")] = 5
    """Rounds of the search."""
    candidates: Annotated[int, flag("C")] = 8
    """Candidates a round."""
    seed: Annotated[int, flag("S")] = 0
    """Root seed, below 10,000: trial i has a seed derived from S and i alone."""
    workers: Annotated[int, flag("W")] = cpu_count()
    """Worker processes; the result does not depend on it."""
    out: Annotated[Path, flag("DIR")] = Path("runs/tuning")
    """Folder for the results and the ledger; an unfinished search in it is continued."""


def main(argv: Sequence[str]) -> int:
    """Run the command; the exit status: 0, 1 if it could not be done, 2 for a mistake of the user, 130 for Ctrl-C."""
    try:
        options, _ = parsed(Tune, PROG, argv)
        checked(options)
        with contextlib.redirect_stdout(sys.stderr), Ledger(options.out, __version__) as ledger:
            path = search(options, ledger)
    except SettingsError as error:
        return fail(PROG, error, 2)
    except CampaignError as error:
        return fail(PROG, error, 1)
    except KeyboardInterrupt:
        return fail(PROG, "stopped; the same command continues", 130)
    print(path)
    return 0


def checked(options: Tune) -> None:
    """Refuse what cannot be.

    Raises:
        SettingsError: names the option.
    """
    if options.controller not in TEAMS:
        raise SettingsError(f"controller: {options.controller!r} cannot be tuned; there are {', '.join(TEAMS)}")
    if not 0 <= options.seed < TUNING_SEEDS:
        raise SettingsError(f"seed: {options.seed} is no tuning seed; those are 0 to {TUNING_SEEDS - 1}")
    at_least(vars(options), {"rounds": 1, "candidates": 1, "workers": 1})
    if importlib.util.find_spec("optuna") is None:
        raise SettingsError("optuna is missing: pip install 'shepherd-phys[tune]'")


def search(options: Tune, ledger: Ledger) -> Path:
    """Run the whole search; the file with its result.

    Raises:
        CampaignError: the ledger cannot be written, or an episode fails again and again.
    """
    import optuna

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    name = options.controller
    space = {**TEAM, **TEAMS[name][2]}
    study = optuna.create_study(
        direction="maximize",
        # all candidates of a round are asked for before any of them is judged
        sampler=optuna.samplers.TPESampler(
            seed=options.seed, n_startup_trials=2 * options.candidates, multivariate=True
        ),
    )
    start = lengths(type(TEAMS[name][1])(), space)
    rng = np.random.default_rng(options.seed)
    best = start
    found: dict[tuple[tuple[str, float], ...], list[float]] = {}
    order: list[tuple[tuple[str, float], ...]] = []
    for number in range(options.rounds):
        for i in range((options.candidates + 1) // 2):
            study.enqueue_trial(start if number == 0 and i == 0 else near(best, space, rng))
        asked = [study.ask() for _ in range(options.candidates)]
        field = [
            {key: round(trial.suggest_float(key, low, high), DECIMALS) for key, (low, high, _) in space.items()}
            for trial in asked
        ]
        field[0] = start if number == 0 else field[0]  # not rounded
        racing, first = list(range(len(field))), 0
        results: list[list[float]] = [[] for _ in field]
        for heat, trials in enumerate(ROUND):
            seeds = [trial_seed(options.seed, trial) for trial in range(first, first + trials)]
            first += trials
            for i, scores in zip(racing, scored(name, [field[i] for i in racing], seeds, options, ledger), strict=True):
                results[i] += scores
            racing.sort(key=lambda i: -np.mean(results[i]))
            if heat < len(ROUND) - 1:
                racing = racing[: max(1, len(racing) // 2)]
        for i, trial in enumerate(asked):
            study.tell(trial, float(np.mean(results[i])))
            found[tuple(field[i].items())] = results[i]
        # who played more episodes has beaten others to get there
        order = sorted(found, key=lambda key: (-len(found[key]), -float(np.mean(found[key]))))
        best = dict(order[0])
        print(f"{PROG}: round {number + 1} of {options.rounds}: best {np.mean(found[order[0]]):.2f}", flush=True)
    finalists = [dict(key) for key in order[:FINALISTS] if dict(key) != start] + [start]
    first = sum(ROUND)
    seeds = [trial_seed(options.seed, trial) for trial in range(first, first + CONFIRM)]
    final = [float(np.mean(scores)) for scores in scored(name, finalists, seeds, options, ledger)]
    best_of_all = int(np.argmax(final))
    flags = " ".join(f"--{key} {getattr(options, key)}" for key in ("controller", "rounds", "candidates", "seed"))
    record = {
        "command": f"{PROG} {flags}",
        "version": __version__,
        "optuna": optuna.__version__,
        "seeds": f"search: trials 0 to {first - 1} of root seed {options.seed}; finalists: the next {CONFIRM}",
        "score": f"in_goal_end - {SECOND} time_to_95, mean over the points (flocks, n, shepherds) {list(POINTS)}",
        "score_of_the_best": final[best_of_all],
        "score_of_the_values_before": final[-1],
        "values": finalists[best_of_all],
    }
    path = options.out / f"{name}.toml"
    write_toml(record, path)
    return path


def near(best: Candidate, space: Space, rng: np.random.Generator) -> Candidate:
    """A candidate beside the best: a few lengths moved by a step or two, within what is searched."""
    moved = dict(best)
    for key in rng.choice(sorted(space), min(MOVED, len(space)), replace=False).tolist():
        low, high, step = space[key]
        ahead = moved[key] + step * int(rng.choice([-STEPS, -1, 1, STEPS]))
        moved[key] = round(min(max(ahead, low), high), DECIMALS)
    return moved


def lengths(settings: TeamSettings, space: Space) -> Candidate:
    """What is searched of a team's settings."""
    values = settings.to_dict()
    return {key: float(values[key]) for key in space}


def scored(
    name: str, field: Sequence[Candidate], seeds: Sequence[int], options: Tune, ledger: Ledger
) -> list[list[float]]:
    """The scores of each candidate's episodes on every point and seed.

    Raises:
        CampaignError: an episode has no result.
    """
    todo = []
    for candidate in field:
        for point in POINTS:
            scenario = scenario_of(*point)
            plain = {"controller": name, "values": candidate, "scenario": scenario.to_dict(), "version": __version__}
            digest = settings_hash(plain)
            todo += [campaign.Task(digest, seed, (name, candidate, point), f"{name} at {point}") for seed in seeds]
    with progress_bar() as report:
        outcome = campaign.run(todo, episode, workers=options.workers, ledger=ledger, report=report)
    if outcome.failures:
        raise CampaignError(f"no result in {outcome.failures[0].attempts} attempts: {outcome.failures[0]}")
    met = dict(zip(dict.fromkeys(task.key for task in todo), outcome.rows, strict=True))  # equal candidates play once
    scores = [float((met[task.key] or {})["score"]) for task in todo]
    size = len(POINTS) * len(seeds)
    return [scores[i * size : (i + 1) * size] for i in range(len(field))]


def episode(spec: tuple[str, Candidate, tuple[int, int, int]], seed: int) -> dict[str, Any]:
    """Run one episode of a candidate: the work of the campaign."""
    name, values, point = spec
    team, settings, _ = TEAMS[name]
    row = evaluate(team(settings.but(**values)), partial(ShepherdingEnv, scenario_of(*point)), [seed])[0]
    return {"score": row["in_goal_end"] - SECOND * row["time_to_95"]}


def scenario_of(n_flocks: int, n_neighbours: int, n_shepherds: int) -> Scenario:
    """The paper's scenario at a point."""
    paper = SCENARIOS["paper"]
    return paper.but(n_flocks=n_flocks, shepherds=n_shepherds, flock=paper.flock.but(n_neighbours=n_neighbours))
