"""Parts of a `shepherd_phys.learning.preset.Preset`: the critic's network, PPO's settings, how policies are judged."""

from __future__ import annotations

from typing import Annotated

from pydantic import BeforeValidator, Field

from shepherd_phys.settings import Settings, listed, settings

MOST_EPISODES = 1_000_000
"""Of a validation."""

# bounds are far above what anybody trains, and below what no machine holds: a slip costs an error, not the memory
Count = Annotated[int, Field(ge=1, le=10_000)]
Counts = Annotated[tuple[Count, ...], Field(min_length=1, max_length=10_000), BeforeValidator(listed)]


@settings
class CriticNetwork(Settings):
    """The critic: groups of its own as the actor's, joined with what it may see of the world, and two layers."""

    world: int = Field(default=128, ge=1, le=4096)
    """Width of the layer over the numbers of the world, where the critic is given them."""
    hidden: int = Field(default=192, ge=1, le=4096)
    """Width of the layer that joins both."""
    latent: int = Field(default=64, ge=1, le=4096)
    """Width of the last layer before the value."""


@settings
class PPOSettings(Settings):
    """Of stable-baselines3's PPO, under its names; counts are of decisions."""

    n_steps: int = Field(default=50, ge=1, le=1_000_000)
    """Decisions of each shepherd in a rollout."""
    batch_size: int = Field(default=2400, ge=2)
    """Decisions in a minibatch."""
    n_epochs: int = Field(default=4, ge=1, le=10_000)
    """Passes over a rollout."""
    learning_rate: float = Field(default=3e-4, gt=0)
    """Of Adam."""
    last_learning_rate: float | None = Field(default=None, gt=0)
    """It falls to this one, linearly over the budget; none: it stays."""
    gamma: float = Field(default=0.98, gt=0, lt=1)
    """Discount a decision."""
    gae_lambda: float = Field(default=0.95, ge=0, le=1)
    """lambda of the generalised advantage estimation."""
    clip_range: float = Field(default=0.2, gt=0)
    """Of the ratio of probabilities."""
    ent_coef: float = Field(default=0.0, ge=0)
    """Weight of the entropy in the loss."""
    vf_coef: float = Field(default=0.5, ge=0)
    """Weight of the value's error in the loss."""
    max_grad_norm: float = Field(default=0.5, gt=0)
    """Longer gradients are cut to this length."""
    log_std_init: float = Field(default=-0.3, ge=-5, le=1)
    """Logarithm of the exploration's standard deviation at the start."""
    last_log_std: float | None = Field(default=None, ge=-5, le=1)
    """That logarithm may be no more than a line from ``log_std_init`` to this one, whatever is learned: a policy acts
    with little or none of it when it is deployed, and must learn to get out of where only exploration got it out. None:
    no such line."""
    last_log_std_at: int = Field(default=4_000_000, ge=1, le=10**15)
    """Shepherd-steps at which the line reaches ``last_log_std``, where it stays."""


@settings
class Validation(Settings):
    """How policies are judged during training: as they are deployed, by numpy, on seeds of their own."""

    flocks: Counts = (1, 2, 5)
    """Numbers of flocks; every combination of the three lists is a point."""
    cohesion: Counts = (40,)
    """Neighbours n that attract a sheep, where the flock model has an n."""
    shepherds: Counts = (3,)
    """Team sizes."""
    trials: int = Field(default=4, ge=1, le=MOST_EPISODES)
    """Episodes a point."""
    seed: int = Field(default=10_000, ge=10_000, le=19_999)
    """Root seed; trial i has the seed that `shepherd-phys evaluate --seed` gives it."""
    every: int = Field(default=1, ge=1, le=10**9)
    """Checkpoints from one validation to the next. The end of a run is validated whatever its number."""
    passes: float | None = Field(default=None, gt=0, le=100)
    """Sheep delivered that every point must reach [%]: the first policy for which all do is kept; none: no such."""
    path_cost: float = Field(default=0.0, ge=0)
    """What a metre walked takes off the sheep delivered when the best policy is chosen [% / m]."""

    def __post_init__(self) -> None:
        if self.n_points * self.trials > MOST_EPISODES:
            raise ValueError(
                f"{self.n_points} points x {self.trials} trials: at most {MOST_EPISODES} episodes a validation"
            )

    @property
    def n_points(self) -> int:
        """Points of a validation, where the flock model has an n."""
        return len(self.flocks) * len(self.cohesion) * len(self.shepherds)
