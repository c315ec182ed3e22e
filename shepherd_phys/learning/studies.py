"""Which runs the experiments about learning consist of: figure 1, and what each ingredient of `fast` buys."""

from __future__ import annotations

import math
from typing import NamedTuple

from shepherd_phys.learning.parts import Validation
from shepherd_phys.learning.preset import Preset, load_preset

FIRST_SEED = 1_000_000
"""Of training; run k of a scheme has this plus k."""
HOME = 97.0
"""Sheep delivered with each of 1 to 5 flocks at which a policy counts as bringing them home [%]."""
SCHEMES = ("wild", "any", "original")
"""Of figure 1, in the order of its tables."""
FIGURE1 = Validation(flocks=(1, 2, 3, 4, 5), trials=20)
PAPER_EVERY = 5
"""Checkpoints of `paper` from one validation to the next: it is slow, and so are its episodes."""
TIMED = 3
"""Runs of `wild` in figure 1 whose wall time to home is told: they are trained alone, with all the workers."""
ABLATIONS = Validation(flocks=(1, 2, 5), trials=20, every=1_000_000)  # none but the last, which every run has


class Run(NamedTuple):
    """A training run of an experiment."""

    name: str
    """Of its folder."""
    recipe: str
    """The preset that it is, or the variant of one."""
    preset: Preset
    hours: float = math.inf
    """Of training, after which it ends though its budget is not spent."""
    timed: bool = False
    """Whether its wall time is told as what a user would wait: nothing is trained beside it."""


def figure1(n_seeds: int, budget: int, paper_hours: float) -> list[Run]:
    """The runs of figure 1 in the order in which they are wanted: an unfinished study knows something of everything.

    First those of `wild` that are timed, then the paper's recipe, which takes longest, then seed by seed the others.

    Args:
        n_seeds: runs of each scheme.
        budget: shepherd-steps of each.
        paper_hours: of the one run of preset `paper`; 0: none.
    """
    fast = load_preset("fast").but(budget=budget, validation=FIGURE1.but(passes=HOME))
    runs = [
        Run(
            f"{reward}-{FIRST_SEED + k}",
            "fast",
            fast.but(reward=reward, seed=FIRST_SEED + k),
            timed=reward == "wild" and k < TIMED,
        )
        for k in range(n_seeds)
        for reward in SCHEMES
    ]
    beside = [run for run in runs if not run.timed]
    if paper_hours:
        paper = load_preset("paper").but(seed=FIRST_SEED, validation=FIGURE1.but(every=PAPER_EVERY))
        beside.insert(0, Run(f"paper-{paper.reward}-{paper.seed}", "paper", paper, paper_hours))
    return [run for run in runs if run.timed] + beside


def ablations(n_seeds: int, budget: int) -> list[Run]:
    """The runs of the ablations, seed by seed, so that an unfinished study knows something about every variant.

    Runs end with whole checkpoint intervals, which the presets count in rollouts: here the budget is cut into as many
    as `fast` would need, rounded up to whole rollouts, so that none trains longer than another, nor than it must.

    Args:
        n_seeds: runs of each variant.
        budget: shepherd-steps of each.
    """
    compared = variants()
    first = next(iter(compared.values()))
    interval = budget / math.ceil(budget / (first.checkpoint_rollouts * first.rollout_steps))
    return [
        Run(
            f"ablation-{name}-{seed}",
            name,
            preset.but(
                seed=seed,
                budget=budget,
                validation=ABLATIONS,
                checkpoint_rollouts=math.ceil(interval / preset.rollout_steps),
            ),
        )
        for seed in range(FIRST_SEED, FIRST_SEED + n_seeds)
        for name, preset in compared.items()
    ]


def variants() -> dict[str, Preset]:
    """What is compared, by name: `fast` less one ingredient each, and `paper` with one more after another.

    All of them observe 64 sectors, by the network that goes with them. None wanders once it is trained, which takes the
    goal straight ahead: they differ in what they learned, not in what was added to it.
    """
    fast = load_preset("fast").but(wander=None)
    found = {
        "fast": fast,
        "fast-world-frame": fast.but(lidar=fast.lidar.but(frame="world")),
        "fast-team-credit": fast.but(credit="team"),
        "fast-own-critic": fast.but(critic_sees="own"),
        "fast-every-step": deciding_every(fast, 1),
        "fast-alpha-0": fast.but(alpha=0.0),
        # the paper's claim that this scheme fails: figure 1 has it with the goal straight ahead
        "fast-original-world-frame": fast.but(reward="original", lidar=fast.lidar.but(frame="world")),
    }
    paper = load_preset("paper")
    added = paper.but(lidar=paper.lidar.but(sectors=fast.lidar.sectors), network=fast.network)
    found["paper-64"] = added
    added = added.but(lidar=added.lidar.but(frame=fast.lidar.frame))
    found["paper-64-frame"] = added
    added = added.but(credit=fast.credit)
    found["paper-64-frame-credit"] = added
    added = added.but(critic_sees=fast.critic_sees)
    found["paper-64-frame-credit-critic"] = added
    # PPO's settings stay the paper recipe's, which count decisions: the last ingredient is the interval with all that
    # it brings, a longer rollout and a longer sight among them
    found["paper-64-frame-credit-critic-interval"] = added.but(decision_interval=fast.decision_interval)
    return found


def deciding_every(preset: Preset, interval: int) -> Preset:
    """A preset that decides every so many control steps: the same discount and lambda a second, as long a rollout.

    The rollout's length is rounded to whole decisions; the batch holds as many decisions as before, so that there are
    more minibatches, or fewer.
    """
    longer = interval / preset.decision_interval
    own = preset.ppo
    ppo = own.but(
        gamma=own.gamma**longer, gae_lambda=own.gae_lambda**longer, n_steps=max(1, round(own.n_steps / longer))
    )
    return preset.but(decision_interval=interval, ppo=ppo)
