"""``shepherd-phys benchmark``: how fast the simulator is, as ratios measured side by side in one run.

The load is driving: the ``strombom`` team at work on one flock of 100 sheep, counted while at least half of them are
threatened. A full step is the environment's: flock, engine, 3 x 3 x 512 beams, observation, ``wild`` rewards with
their extra scan. One core.
"""

from __future__ import annotations

import json
import os
import platform
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Annotated, Any

import numpy as np
import tyro

from shepherd_phys.controllers.base import Controller
from shepherd_phys.controllers.evaluation import ControllerError, run_episode, trial_seed
from shepherd_phys.controllers.strombom import StrombomSettings, StrombomTeam
from shepherd_phys.envs import ShepherdingEnv
from shepherd_phys.flock import Strombom
from shepherd_phys.lidar import Lidar
from shepherd_phys.observation import Stack, encode
from shepherd_phys.scenario import Scenario
from shepherd_phys.settings import SettingsError
from shepherd_phys.state import WorldState
from shepherd_phys.world import World

from .command import at_least, fail, parsed
from .drawing import drawing
from .impacts import impacts
from .obstacle_cost import obstacle_cost
from .plain import PlainWorld
from .points import find_controller
from .throughput import throughput

PROG = "shepherd-phys benchmark"
LENGTHS = StrombomSettings()
"""Of the team that drives: not the tuned ones, so that the load stays the same when those change."""
SEED = 0
"""Root seed of the episodes that are timed (tuning seeds)."""
REFERENCE = {"substeps": 1, "iterations": 10}
"""The reference step: what one ``space.step`` of a whole control step costs."""


@dataclass
class Arguments:
    """Measure the simulator's speed; nothing else should run meanwhile."""

    json: bool = False
    """Print one JSON object on stdout and nothing else there."""
    runs: Annotated[int, tyro.conf.arg(metavar="R")] = 5
    """Runs of which the medians are reported."""
    steps: Annotated[int, tyro.conf.arg(metavar="N")] = 600
    """Control steps that each run counts."""
    impacts: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Instead: N impacts of sheep and shepherds, alone and pushed, on thin obstacles of every kind."""
    obstacles: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Instead: the time outside the engine with N obstacles of all kinds over the same without."""
    engine: bool = False
    """Instead: compare numbers of substeps and iterations by cost, overlap and impacts."""
    campaign: bool = False
    """Instead: episodes a second of a campaign with one worker and with two."""
    render: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Instead: N pictures of the paper's world a run, with trails, from a camera that stands and one that moves."""
    controller: Annotated[str | None, tyro.conf.arg(metavar="NAME|FILE")] = None
    """Instead: which part of an episode this controller takes, a policy for example; and episodes a second."""
    seeds: Annotated[int, tyro.conf.arg(metavar="N")] = 4
    """Episodes (of each controller) that a run of --campaign or --controller counts."""


class Stopwatch:
    """Seconds spent in a function, and how often it was called."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function, self.seconds, self.calls = function, 0.0, 0

    def __call__(self, *args: Any, **values: Any) -> Any:
        """Call the function and count its time."""
        start = time.perf_counter()
        result = self.function(*args, **values)
        self.seconds += time.perf_counter() - start
        self.calls += 1
        return result


def driving_scenario() -> Scenario:
    """The paper's world with one flock: the most sheep threatened at once."""
    return Scenario(n_flocks=1)


def threatened(state: WorldState, scenario: Scenario) -> float:
    """Fraction of the sheep with a shepherd within r_s."""
    apart = np.linalg.norm(state.sheep_pos[:, None] - state.shepherd_pos[None], axis=2)
    return float((apart.min(axis=1) <= scenario.flock.detection_radius).mean())


class Driven:
    """A world or env with its own driving team; where it is watched, engine time is counted apart from the rest.

    A watched world makes its engine steps one by one, so that they can be timed: the whole then takes longer.
    """

    def __init__(
        self, world: World, step: Callable[[Any], Any], reset: Callable[[int], Any], *, watched: bool = True
    ) -> None:
        self.world, self.step, self._reset, self._watched = world, Stopwatch(step), reset, watched
        self.team = StrombomTeam(LENGTHS)

    def reset(self, seed: int) -> None:
        """Begin an episode; its Space is new, so its stopwatch is, too."""
        self._reset(seed)
        self.team.reset(self.world.user_rng)
        self.engine = Stopwatch(self.world.space.step)
        if self._watched:
            self.world.space.step = self.engine  # type: ignore[method-assign]

    def advance(self) -> tuple[float, float]:
        """One control step: seconds of the whole, and of the engine in it (0 where it is not watched)."""
        action = self.team.act(np.empty(0, dtype=np.float32), self.world.state)
        whole, engine = self.step.seconds, self.engine.seconds
        self.step(action)
        return self.step.seconds - whole, self.engine.seconds - engine


def drive(scenario: Scenario, n_steps: int, seed: int, *, with_plain: bool = True) -> dict[str, float]:
    """One run: steps of the env, of two watched worlds and, now and then, a plain one, on the same episodes in turn.

    The watched worlds are the env's twin, for its engine's time, and the reference.
    """
    env = ShepherdingEnv(scenario, rewards="wild")
    twin_world = World(scenario.but(**REFERENCE))
    mine = Driven(env.world, env.step, lambda s: env.reset(seed=s), watched=False)
    same_world = World(scenario)
    same = Driven(same_world, same_world.step, same_world.reset)
    twin = Driven(twin_world, twin_world.step, twin_world.reset)
    whole = engine = reference = plain = beside = 0.0
    counted = pairs = 0
    while counted < n_steps:
        mine.reset(seed)
        same.reset(seed)
        twin.reset(seed)
        seed += 1
        for _ in range(scenario.n_steps):
            before = env.state
            action = mine.team.act(np.empty(0, dtype=np.float32), before)
            seconds, _ = mine.advance()
            _, physics = same.advance()
            _, other = twin.advance()
            if threatened(env.state, scenario) < 0.5:
                continue
            counted += 1
            whole, engine, reference = whole + seconds, engine + physics, reference + other
            if with_plain and counted % 40 == 0:
                slow = PlainWorld(scenario, before, np.random.default_rng(seed))
                start = time.perf_counter()
                slow.step(action)
                plain += time.perf_counter() - start
                beside += seconds
                pairs += 1
            if counted >= n_steps:
                break
    result = {
        "world_steps_per_second": counted / whole,
        "overhead_ratio": (whole - engine) / reference,
        "physics_ratio": engine / reference,
        "step_us": whole / counted * 1e6,
        "engine_us": engine / counted * 1e6,
        "reference_us": reference / counted * 1e6,
    }
    if pairs:
        # the steps beside a plain one run on caches that it has emptied: compare with the mean of all
        result["speedup_over_plain_pymunk"] = (plain / pairs) / (whole / counted)
        result["plain_us"] = plain / pairs * 1e6
    return result


def parts(scenario: Scenario) -> dict[str, float]:
    """Microseconds of each part of a step, on a state in the middle of driving, each timed alone."""
    env = ShepherdingEnv(scenario, rewards="wild")
    team = StrombomTeam(LENGTHS)
    env.reset(seed=SEED)
    team.reset(env.user_rng)
    while True:
        before = env.state
        env.step(team.act(np.empty(0, dtype=np.float32), before))
        if threatened(env.state, scenario) == 1.0 and env.state.step > 100:
            break
    world, lidar, rng = env.world, Lidar(), np.random.default_rng(0)
    scan, stack = world.scan(lidar, ("wild",)), Stack(lidar)
    offset = np.zeros(scenario.n_shepherds, dtype=np.int64)

    def observation() -> None:
        stack.push(encode(scan, lidar))
        stack.observe(offset)

    def rewards() -> None:
        for _, term in env._scheme.values():
            term(before, env.state, scan, scenario)

    timed: dict[str, Callable[[], Any]] = {
        "flock": lambda: scenario.flock.velocities(before, rng),
        "lidar": lambda: world.scan(lidar, ("wild",)),
        "observation": observation,
        "rewards": rewards,
    }
    result = {}
    for name, function in timed.items():
        times = []
        for _ in range(400):
            start = time.perf_counter()
            function()
            times.append(time.perf_counter() - start)
        result[name] = statistics.median(times) * 1e6
    return result


def scaling(counts: tuple[int, ...] = (100, 1_000, 10_000)) -> dict[str, float]:
    """Microseconds per sheep and step, flock and physics only, every sheep threatened, after 50 steps of settling."""
    result = {}
    for n in counts:
        scenario = Scenario(
            n_sheep=n,
            n_flocks=1,
            flock_sd=float(np.sqrt(n / 100)),
            flock=Strombom(detection_radius=1e6, n_neighbours=40),
        )
        world = World(scenario)
        world.reset(SEED)
        still = np.zeros((scenario.n_shepherds, 2))
        for _ in range(50):
            world.step(still)
        times = []
        for _ in range(max(5, 20_000 // n)):
            start = time.perf_counter()
            world.step(still)
            times.append(time.perf_counter() - start)
        result[str(n)] = statistics.median(times) / n * 1e6
    return result


def acting(controller: Controller, n_seeds: int) -> dict[str, float]:
    """One run: episodes of the paper's world as an evaluation runs them, on one core; acting is timed by itself."""
    env = ShepherdingEnv(Scenario(), rewards={}, lidar=controller.lidar)
    act = Stopwatch(controller.act)
    timed = SimpleNamespace(reset=controller.reset, act=act)
    start = time.perf_counter()
    for trial in range(n_seeds):
        run_episode(timed, env, trial_seed(SEED, trial))
    seconds = time.perf_counter() - start
    return {
        "acting_share": act.seconds / seconds,
        "acting_us": act.seconds / act.calls * 1e6,
        "episodes_per_second": n_seeds / seconds,
    }


def overlaps(scenario: Scenario, n_steps: int = 1_500) -> dict[str, float]:
    """How deep sheep are in one another and in shepherds while driven, at the end of each control step [m]."""
    world, team, seed = World(scenario), StrombomTeam(LENGTHS), SEED
    deepest: list[float] = []
    while len(deepest) < n_steps:
        world.reset(seed)
        team.reset(world.user_rng)
        seed += 1
        for _ in range(scenario.n_steps):
            state = world.step(team.act(np.empty(0, dtype=np.float32), world.state))
            if threatened(state, scenario) < 0.5:
                continue
            pos = np.concatenate([state.sheep_pos, state.shepherd_pos])
            radius = np.concatenate([state.sheep_radius, state.shepherd_radius])
            gap = np.linalg.norm(pos[:, None] - pos[None], axis=2) - radius[:, None] - radius[None]
            np.fill_diagonal(gap, np.inf)
            deepest.append(max(0.0, -gap.min()))
    return {"median": float(np.median(deepest)), "p99": float(np.quantile(deepest, 0.99)), "max": max(deepest)}


def compare_engines(runs: int, n_steps: int, n_impacts: int) -> list[dict[str, Any]]:
    """Cost, overlap and tunnelling for numbers of substeps and iterations, interleaved run by run."""
    choices = [(1, 4), (1, 10), (2, 1), (2, 2), (2, 3), (2, 4), (2, 6), (2, 10), (3, 4), (4, 4)]
    ratios: dict[tuple[int, int], list[float]] = {choice: [] for choice in choices}
    for run in range(runs):
        for substeps, iterations in choices:
            scenario = driving_scenario().but(substeps=substeps, iterations=iterations)
            ratios[substeps, iterations].append(
                drive(scenario, n_steps, SEED + 100 * run, with_plain=False)["physics_ratio"]
            )
            print(f"run {run + 1}/{runs}: {substeps} substeps x {iterations} iterations", file=sys.stderr)
    rows = []
    for substeps, iterations in choices:
        scenario = driving_scenario().but(substeps=substeps, iterations=iterations)
        deep = overlaps(scenario)
        hit = impacts(n_impacts, seed=SEED, substeps=substeps, iterations=iterations)
        rows.append(
            {
                "substeps": substeps,
                "iterations": iterations,
                "physics_ratio": statistics.median(ratios[substeps, iterations]),
                "overlap_median_m": deep["median"],
                "overlap_p99_m": deep["p99"],
                "overlap_max_m": deep["max"],
                "impacts": hit["impacts"],
                "tunnelled": hit["tunnelled"],
            }
        )
    return rows


def machine() -> str:
    """What the figures were measured on."""
    model = platform.processor() or platform.machine()
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            model = next((line.split(":", 1)[1].strip() for line in file if line.startswith("model name")), model)
    except OSError:
        pass  # not Linux: what platform knows must do
    return f"{model}, {os.cpu_count()} cores, Python {platform.python_version()}"


def main(argv: list[str]) -> int:
    """Run the command."""
    try:
        args, _ = parsed(Arguments, PROG, argv)
        at_least(vars(args), {"runs": 1, "steps": 1, "seeds": 1, "impacts": 0, "obstacles": 0, "render": 0})
    except SettingsError as error:
        return fail(PROG, error, 2)
    result: Any
    if args.campaign:
        result = throughput(args.runs, args.seeds)
    elif args.controller is not None:
        try:
            controller = find_controller(args.controller)
        except (ControllerError, SettingsError) as error:
            return fail(PROG, error, 2)
        acting(controller, 1)  # compile everything first
        timed = [acting(controller, args.seeds) for _ in range(args.runs)]
        result = {key: statistics.median(run[key] for run in timed) for key in timed[0]}
        result |= {"controller": args.controller, "episodes": args.seeds, "runs": args.runs}
    elif args.render:
        try:
            drawing(2, SEED)  # compile everything first
            drawn = [drawing(args.render, SEED + run) for run in range(args.runs)]
        except ImportError as error:
            return fail(PROG, error, 2)
        result = {key: statistics.median(run[key] for run in drawn) for key in drawn[0]}
        result |= {"pictures": args.render, "runs": args.runs}
    elif args.engine:
        result = compare_engines(args.runs, args.steps, args.impacts or 5_000)
    elif args.obstacles:
        obstacle_cost(args.obstacles, 50, SEED)  # compile everything first
        costs = [obstacle_cost(args.obstacles, args.steps, SEED + 100 * run) for run in range(args.runs)]
        result = {key: statistics.median(run[key] for run in costs) for key in costs[0]}
        result |= {"obstacles": args.obstacles, "runs": args.runs}
    elif args.impacts:
        result = impacts(args.impacts, seed=SEED)
    else:
        drive(driving_scenario(), 50, SEED)  # compile everything first
        runs = []
        for run in range(args.runs):
            runs.append(drive(driving_scenario(), args.steps, SEED + 100 * run))
            print(f"run {run + 1}/{args.runs}: {runs[-1]['world_steps_per_second']:.0f} steps/s", file=sys.stderr)
        scales = [scaling() for _ in range(min(args.runs, 3))]
        result = {key: statistics.median(run[key] for run in runs) for key in runs[0]}
        result["parts_us"] = parts(driving_scenario())
        result["sheep_scaling"] = {key: statistics.median(s[key] for s in scales) for key in scales[0]}
        result["runs"] = args.runs
    if args.json:
        print(json.dumps(result, indent=2))
        return 0
    print(f"on {machine()}")
    for row in result if isinstance(result, list) else [result]:
        for key, value in row.items():
            shown = f"{value:.4g}" if isinstance(value, float) else value
            if isinstance(value, dict):
                shown = ", ".join(f"{k}: {v:.4g}" for k, v in value.items())
            print(
                f"{key:28} {shown}" if not isinstance(result, list) else f"{key}={shown}",
                end="  " if isinstance(result, list) else "\n",
            )
        if isinstance(result, list):
            print()
    return 0
