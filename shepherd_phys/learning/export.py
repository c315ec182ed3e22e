"""Between a live model of stable-baselines3 and a policy: `to_policy`, `to_sb3`. Never by way of a pickled file."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from torch import nn

from shepherd_phys.controllers.learned import Policy
from shepherd_phys.controllers.network import input_shape
from shepherd_phys.controllers.policy_files import PolicyError, PolicySpec, write_policy
from shepherd_phys.envs.rewards import to_table
from shepherd_phys.learning.network import SectorFeatures, TeamPolicy
from shepherd_phys.learning.parts import CriticNetwork
from shepherd_phys.learning.preset import Preset


def spec_of(preset: Preset, shepherd_steps: int = 0) -> PolicySpec:
    """What the file of a policy trained by ``preset`` says beside its weights."""
    training = preset.to_dict()
    elsewhere = ("scenario", "lidar", "network", "reward", "effort", "effort_team", "gathered", "alpha", "credit")
    for name in (*elsewhere, "rest", "noise", "mirror", "hold", "wander"):
        training.pop(name, None)
    if preset.init is not None:
        training["init"] = Path(preset.init).name  # where it lay is nobody's business
    rewards = {
        "scheme": preset.reward_name,
        "credit": preset.credit,
        "terms": to_table(preset.scheme()),
    }
    return PolicySpec(
        scenario=preset.scenario,
        lidar=preset.lidar,
        network=preset.network,
        action=preset.acting(),
        rewards=rewards,
        training={**training, "algorithm": "PPO of stable-baselines3", "shepherd_steps": shepherd_steps},
    )


def actor_weights(policy: TeamPolicy) -> dict[str, NDArray[np.float32]]:
    """Copies of the actor's weights under the names that policy files give them."""
    return {name: parameter.detach().cpu().numpy().copy() for name, parameter in _actor(policy).items()}


def load_actor(policy: TeamPolicy, weights: Mapping[str, NDArray[np.float32]]) -> None:
    """Put a policy's weights into the actor.

    Raises:
        PolicyError: the network has other weights, or of other sizes.
    """
    actor = _actor(policy)
    _check_names(actor, weights)
    for name, parameter in actor.items():
        if tuple(parameter.shape) != weights[name].shape:
            raise PolicyError(f"{name}: the network needs {tuple(parameter.shape)}; the policy's is of another size")
    with torch.no_grad():
        for name, parameter in actor.items():
            parameter.copy_(torch.as_tensor(np.array(weights[name])))


def to_policy(model: BaseAlgorithm | TeamPolicy, spec: PolicySpec, path: str | Path | None = None) -> Policy:
    """The controller that a live model's actor is; with a ``path``, written there as a policy file, too.

    Args:
        model: of stable-baselines3 with a `TeamPolicy`, or the policy itself.
        spec: what it was trained with.
        path: NAME.json.

    Raises:
        PolicyError: it is no `TeamPolicy`, or not of the sizes that ``spec`` tells.
    """
    policy = model if isinstance(model, TeamPolicy) else model.policy
    if not isinstance(policy, TeamPolicy):
        raise PolicyError(f"only a TeamPolicy can become a policy file (given: {type(policy).__name__})")
    weights = actor_weights(policy)
    checksum = write_policy(path, spec, weights) if path is not None else ""
    return Policy(spec, weights, checksum, Path(path).stem if path is not None else "policy")


def to_sb3(policy: Policy, critic: CriticNetwork | None = None, critic_numbers: int = 0) -> TeamPolicy:
    """A policy of stable-baselines3 with the actor of ``policy``, and a critic that has learned nothing.

    To go on learning, make the model with the same class and sizes and call `load_actor` with ``policy.weights``.

    Args:
        policy: whose actor it takes.
        critic: sizes of the critic; none given: the default ones.
        critic_numbers: numbers that the critic sees of the world, 0: none.
    """
    seen: dict[str, spaces.Space[Any]] = {"lidar": spaces.Box(0.0, 1.0, input_shape(policy.spec.lidar), np.float32)}
    if critic_numbers:
        seen["critic"] = spaces.Box(-np.inf, np.inf, (critic_numbers,), np.float32)
    made = TeamPolicy(
        spaces.Dict(seen),
        spaces.Box(-1.0, 1.0, (2,), np.float32),
        lambda _: 0.0,
        network=policy.spec.network,
        critic=critic or CriticNetwork(),
    )
    load_actor(made, policy.weights)
    made.set_training_mode(False)
    return made


def _actor(policy: TeamPolicy) -> dict[str, nn.Parameter]:
    """The actor's parameters by the names of policy files."""
    features = policy.pi_features_extractor
    assert isinstance(features, SectorFeatures)
    layers = {
        "groups": features.groups,
        "hidden": features.hidden,
        "latent": policy.mlp_extractor.policy_net[0],
        "action": policy.action_net,
    }
    named = {f"{name}.{part}": getattr(layer, part) for name, layer in layers.items() for part in ("weight", "bias")}
    return {**named, "log_std": policy.log_std}


def _check_names(wanted: Collection[str], given: Collection[str]) -> None:
    """Refuse other weights than those wanted."""
    for name in sorted(set(wanted) ^ set(given)):
        raise PolicyError(f"{name}: {'is missing' if name in wanted else 'is no weight of the network'}")
