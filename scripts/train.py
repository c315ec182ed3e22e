"""``shepherd-phys train``: learn a policy by a preset, with checkpoints from which a stopped run goes on."""

from __future__ import annotations

import contextlib
import importlib.util
import math
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from shepherd_phys.layouts import Scattered
from shepherd_phys.learning import checkpoints
from shepherd_phys.learning.folder import (
    BEST,
    CHECKPOINTS,
    CURVE,
    POLICY,
    PRESET,
    VALIDATION,
    agree,
    begin,
    check_resumable,
)
from shepherd_phys.learning.preset import PRESETS, Preset, load_preset
from shepherd_phys.learning.validation import scenarios
from shepherd_phys.settings import SettingsError, kind_of
from shepherd_phys.world import World

from .command import LOG_SECONDS, at_least, clock, counted, cpu_count, fail, flag, parsed
from .own import find_kinds, find_reward, find_scenario, of_kinds, own_classes, try_out

PROG = "shepherd-phys train"
TRIED = 3
"""Seeds on which a scenario is tried out: one that finds room on none of them takes seconds to say so, each time."""
LIBRARIES = ("torch", "stable_baselines3", "tensorboard")


@dataclass(frozen=True)
class Train:
    """Train one policy for all shepherds with PPO of stable-baselines3.

    Writes into the folder --out: best.json and policy.json with their .safetensors (the best policy by validation and
    the latest, which evaluate --controllers takes), curve.csv, validation.csv, checkpoints, and what TensorBoard reads.
    A run that was stopped or killed goes on with --resume, exactly as if nothing had happened.
    """

    preset: Annotated[
        str, flag("NAME|FILE", text=f"How to train: {', '.join(PRESETS)}, or a TOML file of your own.")
    ] = "fast"
    reward: Annotated[str | None, flag("NAME|module:Name", "the preset's")] = None
    """Reward scheme: original, any, wild, or a dict name -> (weight, term) of your own."""
    seed: Annotated[int | None, flag("S", "the preset's")] = None
    """Root of everything random; 1,000,000 and up is meant for training."""
    budget: Annotated[int | None, flag("N", "the preset's")] = None
    """Shepherd-steps (control steps times shepherds) to train for; a run ends with a whole checkpoint interval."""
    init: Annotated[str | None, flag("NAME|FILE", "the preset's")] = None
    """Policy to start from: a shipped one's name or a .json file."""
    scenario: Annotated[str | None, flag("NAME|FILE|module:Name", "the preset's")] = None
    """Scenario, the only one then: places of flocks and obstacles are its own, sizes of teams stay the preset's."""
    obstacles: Annotated[int | None, flag("COUNT", "the scenario's")] = None
    """Discs of radius 1 m, drawn anew for each episode: so many."""
    density: Annotated[float | None, flag("FRACTION", "the scenario's")] = None
    """The same, given as the part of the box's area that they cover."""
    body: Annotated[str | None, flag("NAME|module:Name", "the preset's")] = None
    """Body of every shepherd; those that the preset describes as such keep their parameters."""
    flock: Annotated[str | None, flag("NAME|module:Name", "the preset's")] = None
    """Flock model; if the preset describes such a one, with its parameters."""
    workers: Annotated[int, flag("W")] = cpu_count()
    """Processes for the worlds; the results do not depend on it."""
    out: Annotated[Path | None, flag("DIR", "runs/PRESET-REWARD-SEED..")] = None
    """Folder of the run."""
    resume: tyro.conf.FlagCreatePairsOff[bool] = False
    """Go on with the run in --out; what is your own (--body, --flock, --scenario, --reward) is given again."""


FROM_PRESET = ("seed", "budget", "init")
"""Flags that replace a field of the preset as they are."""


def main(argv: Sequence[str]) -> int:
    """Run the command; the exit status: 0, 1 if training had to stop, 2 for a mistake of the user, 130 for Ctrl-C."""
    try:
        options, flags = parsed(Train, PROG, argv)
        at_least(vars(options), {"seed": 0, "budget": 1, "obstacles": 0, "workers": 1})
        check_libraries()
        kinds = find_kinds(options.body, options.flock)
        folder, preset = prepare(options, flags, kinds)
        anew = options.resume and not checkpoints.any_in(folder / CHECKPOINTS)
        if anew:
            check_resumable(folder, preset)
    except SettingsError as error:
        return fail(PROG, error, 2)
    # imported only now: torch takes seconds to load, which no mistake in the flags should cost
    from shepherd_phys.envs.team import WorkerError
    from shepherd_phys.learning.checkpoints import CheckpointError
    from shepherd_phys.learning.ppo import TrainingError
    from shepherd_phys.learning.run import train
    from shepherd_phys.learning.validation import ValidationError
    from shepherd_phys.workers import WorkersError, explain

    interval = preset.checkpoint_rollouts * preset.rollout_steps
    if preset.budget < interval:
        print(
            f"the budget of {preset.budget:,} shepherd-steps is less than a checkpoint interval, with which runs end: "
            f"{interval:,} are trained (checkpoint_rollouts in a preset of your own)",
            file=sys.stderr,
        )
    print(
        f"{folder}: {preset.worlds} worlds, {preset.n_slots} shepherds, {preset.n_rollouts:,} rollouts of "
        f"{preset.rollout_steps:,} shepherd-steps",
        file=sys.stderr,
    )
    if anew:
        print(f"no checkpoint yet, the first comes after {interval:,} shepherd-steps: it begins anew", file=sys.stderr)
    with progress_bar() as report:
        try:
            best = train(folder, options.workers, report, preset=preset, classes=handed(options, kinds))
        except SettingsError as error:
            return fail(PROG, error, 2)
        except (CheckpointError, TrainingError, ValidationError, WorkerError, WorkersError, OSError) as error:
            return fail(PROG, error, 1)
        except Exception as error:
            notes = getattr(error, "__notes__", ())
            if not notes:  # what a world of this process raised says in which: a user's body, flock model or reward
                raise
            return fail(PROG, f"{explain(error)}, {', '.join(notes)}", 1)
        except KeyboardInterrupt:
            there = checkpoints.any_in(folder / CHECKPOINTS)
            then = "goes on from the last checkpoint" if there else "begins anew: there is no checkpoint yet"
            return fail(PROG, f"stopped: --resume --out {folder} {then}", 130)
    if best is not None:
        print(f"best policy: score {best.score:.1f} after {best.shepherd_steps:,} shepherd-steps")
    for name in (BEST, POLICY, CURVE, VALIDATION):
        if (folder / name).exists():
            print(folder / name)
    return 0


def prepare(options: Train, given: set[str], kinds: Mapping[str, Any]) -> tuple[Path, Preset]:
    """The folder of the run, and what its preset shall be; a new run's folder is made, another one left as it is.

    Args:
        options: the command line.
        given: which of them were.
        kinds: classes of the shepherds' bodies and of the flock model, see `shepherd_phys.scripts.own.find_kinds`.

    Raises:
        SettingsError: the folder holds another run, or none to resume; or the preset is impossible.
    """
    if options.resume:
        if options.out is None:
            raise SettingsError("--resume needs --out, the folder of the run")
        if not (options.out / PRESET).is_file():
            raise SettingsError(f"{options.out}: holds no run to resume (no {PRESET})")
        classes = handed(options, kinds)
        preset = Preset.from_toml(options.out / PRESET, classes)
        wanted = load_preset(options.preset, classes) if "preset" in given else preset
        changed = asked(wanted.but(budget=preset.budget), options, given, kinds)
        try:
            agree(options.out, changed, classes)
        except SettingsError as error:
            raise SettingsError(f"{error}; --resume needs none but --out") from None
        World(changed.scenario)  # finds out what was not handed over
        changed.scheme()
        return options.out, changed  # `train` writes it, once nobody else is at the run
    preset = asked(load_preset(options.preset, kinds.values()), options, given, kinds)
    words = [Path(options.preset).stem, preset.reward_name, str(preset.seed)]
    words += [Path(options.scenario).stem] if options.scenario is not None else []
    words += [f"{name}{getattr(options, name):g}" for name in ("obstacles", "density") if name in given]
    folder = options.out or Path("runs") / "-".join(words)
    # before a folder is made that the next attempt would find
    preset.start()
    # is there room for all obstacles, was everything of a user's own handed over, does any of it fail
    seeds = range(preset.validation.seed, preset.validation.seed + TRIED)
    for scenario in (*preset.extremes(), *scenarios(preset)):
        try_out(World(scenario), seeds, preset.scheme(), preset.lidar)
    begin(folder, preset)
    return folder, preset


def handed(options: Train, kinds: Mapping[str, Any]) -> list[Any]:
    """What of a user's own the command line hands over: classes and functions."""
    scenario = None if options.scenario is None else find_scenario(options.scenario, kinds.values())
    reward = None if options.reward is None else find_reward(options.reward)
    return [*kinds.values(), *own_classes(scenario, reward)]


def asked(preset: Preset, options: Train, given: set[str], kinds: Mapping[str, Any]) -> Preset:
    """The preset with what the flags change.

    Raises:
        SettingsError: a flag's value is impossible, two of them do not go together, or a class lacks something.
    """
    preset = preset.but(**{name: getattr(options, name) for name in FROM_PRESET if name in given})
    if options.reward is not None:
        preset = preset.but(reward=find_reward(options.reward))
    if options.scenario is not None:
        scenario = find_scenario(options.scenario, kinds.values())
        preset = preset.but(scenario=scenario, flock_distance=None, scenarios=(), density=None)
    if options.obstacles is not None and options.density is not None:
        raise SettingsError("--obstacles and --density: both say how many obstacles there are; leave one of them out")
    if options.obstacles is not None or options.density is not None:
        layout = preset.scenario.layout or Scattered(count=0)
        if not isinstance(layout, Scattered):
            given_flag = "--obstacles" if options.obstacles is not None else "--density"
            raise SettingsError(
                f"{given_flag}: scatters discs, and the scenario has a layout of its own, {kind_of(layout)}; give one "
                "or the other"
            )
        layout = layout.but(count=options.obstacles, density=options.density)
        drawn = preset.density
        if drawn is not None and options.density is None:
            raise SettingsError(
                f"--obstacles: the preset draws another density for each episode, {drawn[0]:g} to {drawn[1]:g}; "
                "--density sets it"
            )
        span = None if drawn is None else (options.density, options.density)  # what is drawn is no other then
        preset = preset.but(scenario=preset.scenario.but(layout=layout), density=span)
    if not kinds:
        return preset
    scenario = of_kinds(preset.scenario, kinds)[0]
    drawn = preset.n_neighbours if hasattr(scenario.flock, "n_neighbours") else None
    return preset.but(scenario=scenario, n_neighbours=drawn)


@contextlib.contextmanager
def progress_bar() -> Iterator[Any]:
    """A bar on standard error with pace, time left and the latest measures; validations as lines."""
    console = Console(stderr=True, markup=False, highlight=False)
    bar = Progress(
        BarColumn(), TextColumn("{task.percentage:.0f} %"), TextColumn("{task.fields[told]}"), TimeElapsedColumn(),
        console=console, disable=not console.is_terminal,
    )  # fmt: skip
    shown = bar.add_task("training", total=None, told="starting")
    logged = -math.inf

    def report(now: Any) -> None:
        nonlocal logged
        if now.validation:
            console.print(validation_of(now), soft_wrap=True)
            return
        told = pace_of(now)
        bar.update(shown, total=1.0, completed=now.done, told=told)
        if not console.is_terminal and time.monotonic() - logged > LOG_SECONDS:
            logged = time.monotonic()
            print(f"{now.shepherd_steps:,} shepherd-steps: {told}", file=sys.stderr, flush=True)

    with bar:
        yield report


def pace_of(now: Any) -> str:
    """What a run reports of a rollout, in words; pace and time left are of training, without validations."""
    left = clock(max(0.0, 1.0 - now.done) * now.length / max(now.rate, 1e-9))
    told = f"{now.rate:,.0f} shepherd-steps/s, {left} of training left"
    if math.isfinite(now.measures["episode_reward"]):
        told += f", reward {now.measures['episode_reward']:.2f}, {now.measures['in_goal_end']:.0f} % in"
    return told


def validation_of(now: Any) -> str:
    """What a run reports of a validation, in words."""
    points = ", ".join(
        f"{row['in_goal_end']:.1f} % in, {row['path_length']:.0f} m with {counted(row['n_flocks'], 'flock')}"
        + (f" n {row['cohesion']}" if len({r["cohesion"] for r in now.validation}) > 1 else "")
        + (f" {counted(row['n_shepherds'], 'shepherd')}" if len({r["n_shepherds"] for r in now.validation}) > 1 else "")
        for row in now.validation
    )
    return f"validation at {now.shepherd_steps:,} shepherd-steps: {points}"


def check_libraries() -> None:
    """Find out whether what training needs is there.

    Raises:
        SettingsError: names what is missing.
    """
    missing = [name for name in LIBRARIES if importlib.util.find_spec(name) is None]
    if missing:
        raise SettingsError(f"{', '.join(missing)} is missing: pip install 'shepherd-phys[train]'")
