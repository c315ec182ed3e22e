"""`Preset`: everything that a training run is, as one frozen value; TOML in and out; the presets by name."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BeforeValidator, Field

from shepherd_phys.controllers.hold import Hold
from shepherd_phys.controllers.learned import POLICIES, load_policy
from shepherd_phys.controllers.network import SectorNetwork, Weights, bytes_of, input_shape, with_channels
from shepherd_phys.controllers.policy_files import MAX_FRAMES, MAX_WEIGHTS, Acting
from shepherd_phys.controllers.wander import Wander
from shepherd_phys.envs.mixture import Mixture
from shepherd_phys.envs.rewards import (
    SCHEMES,
    Effort,
    Gathered,
    Occlusion,
    Scheme,
    Term,
    checked,
    from_table,
    to_table,
)
from shepherd_phys.learning.parts import Count, Counts, CriticNetwork, PPOSettings, Validation
from shepherd_phys.lidar import Channel, Lidar
from shepherd_phys.mirror import Side
from shepherd_phys.scenario import SCENARIOS, Scenario
from shepherd_phys.settings import Foreign, Settings, SettingsError, listed, meant, read_toml, settings, write_toml

FOLDER = Path(__file__).parent / "presets"
MOST_NUMBERS = 2**32
"""Of all observations in a rollout: 16 GiB."""
MOST_FRAMES = 2**32
"""Numbers of frames that all shepherds' lidars remember: 16 GiB."""
MOST_SHEEP = 10_000_000
"""In all worlds."""
Range = Annotated[tuple[Count, Count], BeforeValidator(listed)]
Length = Annotated[float, Field(ge=0)]
Span = Annotated[tuple[Length, Length], BeforeValidator(listed)]
Fractions = Annotated[
    tuple[Annotated[float, Field(ge=0, le=0.5)], Annotated[float, Field(ge=0, le=0.5)]], BeforeValidator(listed)
]


@settings
class Preset(Settings):
    """A training run. The defaults are what trains fast, less its wandering; the budget and rates are in shepherd-steps
    (control steps times shepherds).
    """  # noqa: D205

    reward: str | Mapping[str, tuple[float, Any]] = "wild"
    """Name of the reward scheme, or one of your own: name -> (weight, term)."""
    effort: float = Field(default=0.0, ge=0)
    """Weight of the cost of walking; 0: none."""
    effort_team: int = Field(default=1, ge=1, le=1000)
    """Smallest team that pays it in full; see `shepherd_phys.envs.rewards.Effort`."""
    gathered: float = Field(default=0.0, ge=0)
    """Weight of what is paid for while the herd is in the goal, all but a few; 0: nothing."""
    alpha: float | None = Field(default=None, ge=0)
    """Least useful distance of the occlusion term [m]; none: the scheme's."""
    rest: float = Field(default=0.0, ge=0, lt=1)
    """Of the policy when it is deployed, and validated: wanted speeds below this part of the top speed mean standing
    still. Not while learning: whoever wants to stand still and tries little beside could learn nothing else."""
    noise: float = Field(default=0.3, ge=0, le=1)
    """Of the policy when it is deployed, and validated: standard deviations by which its actions scatter about their
    mean, each for as long as a decision while learning; see `shepherd_phys.controllers.policy_files.Acting`."""
    mirror: Side = "never"
    """Of the policy when it is deployed, and validated: which shepherds see the world in a mirror; see
    `shepherd_phys.mirror`."""
    learns_mirrored: bool = False
    """Whether they do so while learning, too."""
    hold: Hold | None = None
    """Of the policy when it is deployed, and validated: how a team holds the herd once it is home; see
    `shepherd_phys.controllers.hold`."""
    wander: Wander | None = None
    """Of the policy when it is deployed, and validated: what a shepherd does whose policy gets it nowhere; see
    `shepherd_phys.controllers.wander`."""
    credit: Literal["own", "team"] = "own"
    """Who is paid for a term that has shares: each shepherd by its own, or all by the mean."""
    decision_interval: int = Field(default=5, ge=1, le=1000)
    """Control steps for which a decision is held while learning."""
    budget: int = Field(default=6_000_000, ge=1, le=10**15)
    """Shepherd-steps of the run, which ends with a whole checkpoint interval; see `n_rollouts`."""
    seed: int = Field(default=1_000_000, ge=0, le=2**63 - 1)
    """Root of everything random."""
    worlds: int = Field(default=64, ge=1, le=10_000)
    """Worlds that run side by side."""
    team_sizes: Counts = (3,)
    """Shepherds of the worlds, in turn."""
    n_flocks: Range | None = None
    """Least and most flocks, drawn anew for every episode; none: the scenario's."""
    n_neighbours: Range | None = None
    """Least and most neighbours n, drawn anew for every episode; none: the scenario's."""
    n_sheep: Range | None = None
    """Least and most sheep, drawn anew for every episode while learning, with their logarithm uniform, so that twice as
    many are as likely as half as many; the goal's area grows and shrinks with their number. None: the scenario's."""
    flock_distance: Span | None = None
    """Least and largest distance of a flock's centre from the goal's while learning [m]; none: the scenario's. Those of
    ``scenarios`` keep their own."""
    uneven: float = Field(default=0.0, ge=0, le=1)
    """Fraction of the episodes whose flocks differ in size."""
    scenarios: Annotated[tuple[str, ...], BeforeValidator(listed)] = ()
    """Names of scenarios. Each episode while learning is in the scenario or in one of these, all with the same
    probability, and with the scenario's bodies, flock model and imperfections. Validation is in the scenario."""
    density: Fractions | None = None
    """Least and largest part of the box that scattered obstacles cover, drawn anew for every episode; none: the
    scenario's."""
    init: str | None = None
    """Policy to start from: a shipped one's name, or a .json file. It may know fewer channels of the lidar."""
    critic_first: int = Field(default=0, ge=0, le=10**9)
    """Rollouts in which only the critic learns: a fresh one would spoil the policy given as ``init``."""
    critic_sees: Literal["world", "own"] = "world"
    """The whole world, or what the actor sees."""
    checkpoint_rollouts: int = Field(default=20, ge=1, le=10**9)
    """Rollouts from one checkpoint to the next. At each all worlds begin anew."""
    threads: int = Field(default=1, ge=1, le=1024)
    """Of torch. With one, a resumed run equals the unbroken one bit for bit."""
    scenario: Scenario = Scenario()
    lidar: Lidar = Field(default_factory=lambda given: Lidar(channels=_channels(**given), sectors=64, frame="goal"))
    """Its channels follow from the scenario and the scenarios where nobody gives them."""
    network: SectorNetwork = SectorNetwork()
    critic: CriticNetwork = CriticNetwork()
    ppo: PPOSettings = PPOSettings()
    validation: Validation = Validation()

    def __post_init__(self) -> None:
        if isinstance(self.reward, str) and self.reward not in SCHEMES:
            raise ValueError(f"reward: {self.reward!r} is not one of {', '.join(SCHEMES)}")
        for name, (_, term) in self._terms().items():
            if not (callable(term) or isinstance(term, Foreign)):
                raise ValueError(f"reward[{name!r}]: needs a term that can be called (given: {term!r})")
        for name in ("effort", "gathered"):
            if getattr(self, name) and name in self._terms():
                raise ValueError(f"{name}: the reward has a term of this name already; rename it, or give {name} = 0")
        for name in self.scenarios:
            if name not in SCENARIOS:
                raise ValueError(f"scenarios: {name!r} is not one of {', '.join(SCENARIOS)}")
        if self.alpha is not None and not any(isinstance(t, Occlusion) for _, t in self._terms().values()):
            raise ValueError(f"alpha: the reward {self.reward_name!r} has no occlusion term (given: {self.alpha})")
        if not self.scenario.shepherds:
            raise ValueError("scenario.shepherds: there must be one, whose body the teams have")
        if self.scenario.flock_sizes is not None:
            raise ValueError("scenario.flock_sizes: validation has other numbers of flocks; uneven draws sizes")
        if max(self.validation.flocks) > self.scenario.n_sheep:
            raise ValueError(
                f"validation.flocks: {max(self.validation.flocks)} flocks of {self.scenario.n_sheep} sheep cannot be"
            )
        try:
            shapes = self.network.shapes(self.lidar)
            self.draw()
            self.acting().check(self.lidar)  # what no policy file can say is refused before anything is learned
        except SettingsError as error:
            raise ValueError(str(error)) from None
        self._check_size(bytes_of(shapes))
        if self.ppo.batch_size > self.n_slots * self.ppo.n_steps:
            raise ValueError(
                f"ppo.batch_size: {self.ppo.batch_size} is more than a rollout holds: "
                f"{self.n_slots} shepherds x {self.ppo.n_steps} decisions"
            )
        if self.learns_mirrored and self.mirror == "never":
            raise ValueError("learns_mirrored: makes sense only with a mirror (given: mirror = 'never')")
        if self.init is None and self.critic_first:
            raise ValueError("critic_first: makes sense only with init")

    def _check_size(self, weights: int) -> None:
        """Refuse what no memory holds, before anything is made, and policies that nobody could read."""
        lidar = self.lidar
        if weights > MAX_WEIGHTS:
            raise ValueError(f"network: {weights} bytes of weights; a policy may have {MAX_WEIGHTS}")
        frames = lidar.remembered
        if frames > MAX_FRAMES:
            raise ValueError(f"lidar: {frames} numbers of frames to remember; a policy may have {MAX_FRAMES}")
        bounds = {
            "worlds, scenario.n_sheep": (self.worlds * self.scenario.n_sheep, "sheep", MOST_SHEEP),
            "worlds, n_sheep": (self.worlds * max(self.n_sheep or (0,)), "sheep", MOST_SHEEP),
            "worlds, team_sizes, lidar": (self.n_slots * frames, "numbers of frames to remember", MOST_FRAMES),
            "worlds, team_sizes, ppo.n_steps, lidar": (
                self.n_slots * self.ppo.n_steps * math.prod(input_shape(lidar)),
                "numbers observed in a rollout",
                MOST_NUMBERS,
            ),
        }
        for fields, (number, what, most) in bounds.items():
            if number > most:
                raise ValueError(f"{fields}: {number} {what}; at most {most}")

    def but(self, **changes: Any) -> Self:
        """A validated copy with ``changes``; channels that followed from the scenarios follow from others, too.

        Raises:
            SettingsError: a field is unknown or its value impossible.
        """
        own = {"scenario": self.scenario, "scenarios": self.scenarios}
        if "lidar" not in changes and self.lidar.channels == _channels(**own):
            changes["lidar"] = self.lidar.but(channels=_channels(**{**own, **changes}))
        return super().but(**changes)

    @property
    def sizes(self) -> tuple[int, ...]:
        """Shepherds of each world."""
        return tuple(self.team_sizes[i % len(self.team_sizes)] for i in range(self.worlds))

    @property
    def n_slots(self) -> int:
        """Shepherds of all worlds."""
        return sum(self.sizes)

    @property
    def rollout_steps(self) -> int:
        """Shepherd-steps of a rollout. A few fewer are taken where the end of an episode cuts a decision short."""
        return self.n_slots * self.ppo.n_steps * self.decision_interval

    @property
    def n_rollouts(self) -> int:
        """Rollouts of the whole run: the fewest whole checkpoint intervals of `rollout_steps` that hold the budget.

        So the length is known beforehand, and runs that differ in nothing but their seeds have equally many.
        """
        return self.checkpoint_rollouts * -(-self.budget // (self.checkpoint_rollouts * self.rollout_steps))

    def draw(self) -> Scenario | Mixture:
        """The scenario, or what draws one for each episode."""
        own = self.scenario
        base = own.but(flock_distance=self.flock_distance) if self.flock_distance else own
        drawn = (self.n_flocks, self.n_neighbours, self.n_sheep, self.uneven, self.scenarios, self.density)
        if not any(drawn):
            return base
        return Mixture(
            base=base,
            n_flocks=self.n_flocks or (base.n_flocks, base.n_flocks),
            n_neighbours=self.n_neighbours,
            n_sheep=self.n_sheep,
            others=tuple(
                SCENARIOS[name].but(
                    shepherds=own.shepherds, sheep=own.sheep, flock=own.flock, imperfections=own.imperfections
                )
                for name in self.scenarios
            ),
            density=self.density,
            uneven=self.uneven,
        )

    def extremes(self) -> list[Scenario]:
        """The scenarios that episodes are in while learning, each with the most obstacles and sheep that are drawn."""
        drawn = self.draw()
        return [drawn] if isinstance(drawn, Scenario) else drawn.extremes()

    @property
    def reward_name(self) -> str:
        """The scheme's name; "own" where it has none."""
        return self.reward if isinstance(self.reward, str) else "own"

    def _terms(self) -> Scheme:
        return SCHEMES[self.reward] if isinstance(self.reward, str) else self.reward

    def scheme(self) -> dict[str, tuple[float, Term]]:
        """The reward scheme, with what the preset changes and adds.

        Raises:
            SettingsError: a term is a user's own and was not handed over.
        """
        scheme = dict(checked(self._terms()))
        if self.alpha is not None:
            for name, (weight, term) in scheme.items():
                if isinstance(term, Occlusion):
                    scheme[name] = (weight, term.but(alpha=self.alpha))
        if self.effort:
            scheme["effort"] = (-self.effort, Effort(team=self.effort_team))
        if self.gathered:
            scheme["gathered"] = (self.gathered, Gathered())
        return scheme

    def acting(self) -> Acting:
        """How its policy acts when it is deployed."""
        return Acting(
            frame=self.lidar.frame,
            rest=self.rest,
            noise=self.noise,
            noise_steps=self.decision_interval,
            mirror=self.mirror,
            hold=self.hold,
            wander=self.wander,
        )

    def start(self) -> Weights | None:
        """Weights of the policy to start from, if there is one.

        A policy that knows fewer of the lidar's channels learns the others from nothing, such as one that never saw
        obstacles.

        Raises:
            SettingsError: it cannot be read, or is not of the preset's lidar and network.
        """
        name = self.init
        if name is None:
            return None
        if name not in POLICIES and not name.endswith(".json"):
            raise SettingsError(f"init: {name!r} is neither a .json file nor a shipped policy ({', '.join(POLICIES)})")
        policy = POLICIES[name]() if name in POLICIES else load_policy(name)
        if policy.spec.network != self.network:
            raise SettingsError(
                f"init: {name} has another network than the preset: {policy.spec.network}, not {self.network}"
            )
        try:
            return with_channels(policy.weights, self.network, policy.spec.lidar, self.lidar)
        except SettingsError as error:
            raise SettingsError(f"init: {name} has another lidar than the preset: {error}") from None

    def to_dict(self) -> dict[str, Any]:
        """Plain data from which `from_dict` makes an equal preset."""
        table = Settings.to_dict(self)
        if not isinstance(self.reward, str):
            table["reward"] = to_table(self.reward)
        return table

    @classmethod
    def from_dict(cls, table: Mapping[str, Any], classes: Iterable[Any] = ()) -> Preset:
        """The preset that plain data describe; what is left out keeps its default.

        Args:
            table: what `to_dict` gives, or parts of it.
            classes: a user's own classes that its scenario and its reward name; nothing is ever imported by name.

        Raises:
            SettingsError: a field is unknown or impossible.
        """
        values, classes = dict(table), tuple(classes)
        if isinstance(values.get("reward"), Mapping):
            values["reward"] = from_table(values["reward"], classes, "Preset.reward")
        name = values.get("scenario")
        if isinstance(name, str):
            if name not in SCENARIOS:
                raise SettingsError(
                    f"Preset.scenario: {name!r} is neither a table nor one of {', '.join(SCENARIOS)} (a file or "
                    f"module:Name of your own is given as --scenario){meant(name, SCENARIOS)}"
                )
            values["scenario"] = SCENARIOS[name]
        if isinstance(values.get("scenario"), Mapping):
            values["scenario"] = Scenario.from_dict(values["scenario"], classes)
        if isinstance(values.get("lidar"), Mapping):  # by now the scenario has been made
            values["lidar"] = {"channels": _channels(**values), **values["lidar"]}
        return cls(**values)

    @classmethod
    def from_toml(cls, path: str | Path, classes: Iterable[Any] = ()) -> Preset:
        """Read a preset from a TOML file; see `from_dict`."""
        table = read_toml(path)
        try:
            return cls.from_dict(table, classes)
        except SettingsError as error:
            raise SettingsError(f"{path}: {error}") from None

    def to_toml(self, path: str | Path) -> None:
        """Write the preset as a TOML file."""
        write_toml(self.to_dict(), path)


def _channels(scenario: Any = None, scenarios: Any = (), **_: Any) -> tuple[Channel, ...]:
    """Of a lidar that sees all there may be in the scenarios of a preset; what is no scenario is refused elsewhere."""
    texts = scenarios if isinstance(scenarios, list | tuple) else ()
    named = [SCENARIOS[name] for name in texts if isinstance(name, str) and name in SCENARIOS]
    every = [scenario if isinstance(scenario, Scenario) else Scenario(), *named]
    return max((one.channels for one in every), key=len)


PRESETS = {path.stem: path for path in sorted(FOLDER.glob("*.toml"))}
"""The presets that come with the package, by name."""


def load_preset(name_or_path: str | Path, classes: Iterable[Any] = ()) -> Preset:
    """A preset by its name, or from a TOML file; ``classes`` as for `Preset.from_dict`.

    Raises:
        SettingsError: it is neither, or the file is not a preset.
    """
    name = str(name_or_path)
    if name in PRESETS:
        return Preset.from_toml(PRESETS[name])
    if name.endswith(".toml"):
        return Preset.from_toml(name, classes)
    raise SettingsError(
        f"preset: {name!r} is neither a .toml file nor one of {', '.join(PRESETS)}{meant(name, PRESETS)}"
    )
