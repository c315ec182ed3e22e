"""PPO of stable-baselines3 on worlds of shepherds: made from a preset, watched, begun anew, saved and restored."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecNormalize

from shepherd_phys.controllers.network import Weights
from shepherd_phys.envs.team import TeamVecEnv
from shepherd_phys.learning.export import _actor, load_actor
from shepherd_phys.learning.network import TeamPolicy
from shepherd_phys.learning.preset import Preset

Array = NDArray[Any]


class TrainingError(RuntimeError):
    """Training cannot go on; the message says why."""


class Learner:
    """A model of stable-baselines3 and its worlds.

    All that is random after `restart` is a function of the preset and the restart's number; so a state is complete
    without generators and without physics: parameters, Adam's moments, the reward's normaliser, counters.

    Args:
        preset: the run.
        n_workers: processes for the worlds; 0: this one. Results do not depend on it.
        logger: of stable-baselines3, for TensorBoard.
        fresh: whether the run begins here; else `restore` is called next, and the preset's ``init`` is not needed.
        start: weights to begin with; None: those of the preset's ``init``, if it names one.

    Raises:
        SettingsError: the policy that the preset names as ``init`` cannot be had, or does not fit.
    """

    def __init__(
        self,
        preset: Preset,
        n_workers: int = 0,
        logger: Logger | None = None,
        fresh: bool = True,
        start: Weights | None = None,
    ) -> None:
        self.preset = preset
        if fresh and start is None:
            start = preset.start()
        torch.set_num_threads(preset.threads)
        ppo = preset.ppo
        self.env = TeamVecEnv(
            preset.draw(),
            preset.sizes,
            rewards=preset.scheme(),
            lidar=preset.lidar,
            decision_interval=preset.decision_interval,
            credit=preset.credit,
            critic=preset.critic_sees,
            mirror=preset.mirror if preset.learns_mirrored else "never",
            seed=preset.seed,
            n_workers=n_workers,
        )
        self._steps_before = 0
        # rewards over the running deviation of discounted returns: the schemes differ in scale
        self.rewards = VecNormalize(self.env, norm_obs=False, gamma=ppo.gamma)
        self._seed_learner(0)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=".*mini-batch size of")  # the last one may be smaller
            self.model = PPO(
                TeamPolicy,
                self.rewards,
                learning_rate=self._learning_rate,
                n_steps=ppo.n_steps,
                batch_size=ppo.batch_size,
                n_epochs=ppo.n_epochs,
                gamma=ppo.gamma,
                gae_lambda=ppo.gae_lambda,
                clip_range=ppo.clip_range,
                ent_coef=ppo.ent_coef,
                vf_coef=ppo.vf_coef,
                max_grad_norm=ppo.max_grad_norm,
                policy_kwargs={
                    "network": preset.network,
                    "critic": preset.critic,
                    "log_std_init": ppo.log_std_init,
                },
                device="cpu",
            )
        self.model.set_logger(logger or Logger(folder=None, output_formats=[]))
        assert isinstance(self.model.policy, TeamPolicy)
        self.policy = self.model.policy
        self.rollouts = 0
        """Rollouts learned from since the run began."""
        if start is not None:
            load_actor(self.policy, start)
            with torch.no_grad():  # what it explored at its end is too little to learn anything new
                self.policy.log_std.fill_(ppo.log_std_init)

    @property
    def shepherd_steps(self) -> int:
        """Control steps times shepherds since the run began."""
        return self._steps_before + self.env.shepherd_steps

    def _seed_learner(self, number: int) -> None:
        """Seed the generators that torch and stable-baselines3 draw from."""
        sequence = np.random.SeedSequence([self.preset.seed, number, 1])
        set_random_seed(int(sequence.generate_state(1)[0]))

    def restart(self, number: int) -> None:
        """Begin anew in all worlds and with all generators; what was under way has been bootstrapped by the rollout.

        Raises:
            TrainingError: an observation is not finite; the message names it.
        """
        self._seed_learner(number)
        observation = self.env.restart(number)
        _check_finite(_named(observation))
        self.rewards.returns = np.zeros(self.env.num_envs)
        self.model._last_obs = observation
        self.model._last_episode_starts = np.ones(self.env.num_envs, dtype=bool)

    def learn(self) -> dict[str, float]:
        """Collect one rollout and learn from it.

        Returns:
            measures of it: means over the whole episodes that ended in it (NaN where none did), and PPO's own.

        Raises:
            TrainingError: something is not finite; the message names the array.
        """
        model = self.model
        only_critic = self.rollouts < self.preset.critic_first
        for parameter in _actor(self.policy).values():
            parameter.requires_grad_(not only_critic)
        self._limit_exploration()
        watch = _Watch()
        n = self.env.num_envs * model.n_steps
        try:
            # who logs has more to tell of a rollout when it has been learned from: nothing is dumped in here
            model.learn(n, callback=watch, reset_num_timesteps=False, log_interval=sys.maxsize)
        except ValueError as error:  # torch's distributions refuse a NaN before anybody else sees it
            if getattr(error, "__notes__", ()):  # a user's own code raised it, in the world that they name
                raise
            self._check_parameters()
            raise TrainingError(f"learning failed: {' '.join(str(error).split())[:300]}") from error
        self.rollouts += 1
        told = model.logger.name_to_value
        for name in ("train/value_loss", "train/policy_gradient_loss", "train/loss"):
            if name in told and not np.isfinite(told[name]):
                raise TrainingError(f"{name} is {told[name]}: training stops")
        self._check_parameters()
        return {
            **watch.measures(),
            **{name.removeprefix("train/"): float(told[name]) for name in LOGGED if name in told},
        }

    def _learning_rate(self, _: float) -> float:
        """By shepherd-steps: stable-baselines3's progress counts from its latest `learn`, which is one rollout."""
        ppo = self.preset.ppo
        if ppo.last_learning_rate is None:
            return ppo.learning_rate
        done = min(self.shepherd_steps / self.preset.budget, 1.0)
        return ppo.learning_rate + (ppo.last_learning_rate - ppo.learning_rate) * done

    def _limit_exploration(self) -> None:
        """Cut log_std to the preset's line, before each rollout."""
        ppo = self.preset.ppo
        if ppo.last_log_std is not None:
            done = min(self.shepherd_steps / ppo.last_log_std_at, 1.0)
            with torch.no_grad():
                self.policy.log_std.clamp_(max=ppo.log_std_init + (ppo.last_log_std - ppo.log_std_init) * done)

    def _check_parameters(self) -> None:
        for name, parameter in self.policy.named_parameters():
            if not bool(torch.isfinite(parameter).all()):
                raise TrainingError(f"parameter {name} is not finite: training stops")

    # ------------------------------------------------------------------ state

    def state(self) -> tuple[dict[str, Array], dict[str, Any]]:
        """All that a resumed run needs, as arrays by name and plain data."""
        arrays: dict[str, Array] = {}
        for name, parameter in self.policy.named_parameters():
            arrays[f"parameter/{name}"] = parameter.detach().numpy().copy()
            for key, value in self.policy.optimizer.state.get(parameter, {}).items():
                arrays[f"adam/{key}/{name}"] = value.detach().numpy().copy()
        moments = self.rewards.ret_rms
        arrays["returns/moments"] = np.array([float(moments.mean), float(moments.var), float(moments.count)])
        facts = {
            "rollouts": self.rollouts,
            "shepherd_steps": self.shepherd_steps,
            "decisions": self.model.num_timesteps,
            "updates": self.model._n_updates,
        }
        return arrays, facts

    def restore(self, arrays: Mapping[str, Array], facts: Mapping[str, Any]) -> None:
        """Take over a `state` of the same preset; `restart` comes next.

        Raises:
            TrainingError: it is another network's.
        """
        optimizer = self.policy.optimizer
        for name, parameter in self.policy.named_parameters():
            saved = arrays.get(f"parameter/{name}")
            if saved is None or saved.shape != tuple(parameter.shape):
                raise TrainingError(f"the checkpoint's {name} is not of the preset's network")
            with torch.no_grad():
                parameter.copy_(torch.from_numpy(saved.copy()))
            moments = {key: arrays.get(f"adam/{key}/{name}") for key in ("step", "exp_avg", "exp_avg_sq")}
            if all(value is not None for value in moments.values()):
                optimizer.state[parameter] = {key: torch.tensor(value) for key, value in moments.items()}
        mean, var, count = arrays["returns/moments"].tolist()
        moments_of_returns = self.rewards.ret_rms
        moments_of_returns.mean, moments_of_returns.var = np.array(mean), np.array(var)
        moments_of_returns.count = count
        self.rollouts = int(facts["rollouts"])
        self._steps_before = int(facts["shepherd_steps"]) - self.env.shepherd_steps
        self.model.num_timesteps = int(facts["decisions"])
        self.model._n_updates = int(facts["updates"])

    def close(self) -> None:
        """End the worlds' processes."""
        self.env.close()


LOGGED = (
    "train/value_loss",
    "train/policy_gradient_loss",
    "train/approx_kl",
    "train/clip_fraction",
    "train/explained_variance",
    "train/std",
)
"""What of PPO's own measures goes into the curve."""
EPISODE = {"episode_reward": "return", "in_goal": "in_goal", "path_length": "path_length"}
"""Measures of whole episodes in the curve, and their names in the env's infos."""


def _named(observation: Mapping[str, Array]) -> dict[str, Array]:
    return {f"observation {name!r}": array for name, array in observation.items()}


def _check_finite(arrays: Mapping[str, Array | torch.Tensor]) -> None:
    """Refuse a NaN and an infinity.

    Raises:
        TrainingError: names the array.
    """
    for name, array in arrays.items():
        finite = torch.isfinite(array).all() if isinstance(array, torch.Tensor) else np.isfinite(array).all()
        if not finite:
            raise TrainingError(f"{name}: holds a NaN or an infinity: training stops")


class _Watch(BaseCallback):
    """Looks at every decision: nothing may be NaN; gathers what whole episodes came to."""

    def __init__(self) -> None:
        super().__init__()
        self._ended: list[dict[str, float]] = []

    def _on_step(self) -> bool:
        seen = self.locals
        arrays = {name: seen[name] for name in ("actions", "values", "log_probs")}
        _check_finite({"rewards": seen["rewards"], **_named(seen["new_obs"]), **arrays})
        worlds: dict[int, list[dict[str, Any]]] = {}
        for info in seen["infos"]:
            if "episode" in info:
                worlds.setdefault(info["world"], []).append(info)
        for team in worlds.values():  # an episode counts once, however many shepherds it has
            self._ended.append({key: float(np.mean([info[key] for info in team])) for key in EPISODE.values()})
        return True

    def measures(self) -> dict[str, float]:
        """How many whole episodes ended, and means over them."""
        found: dict[str, float] = {"episodes": len(self._ended)}
        for name, key in EPISODE.items():
            values = [episode[key] for episode in self._ended]
            found[name] = float(np.mean(values)) if values else float("nan")
        return found
