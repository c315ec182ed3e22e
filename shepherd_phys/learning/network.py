"""Actor and critic in torch: the network of `shepherd_phys.controllers.network`, and a critic that may see more."""

from __future__ import annotations

from typing import Any

import torch
from gymnasium import spaces
from stable_baselines3.common.policies import MultiInputActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, MlpExtractor
from torch import nn

from shepherd_phys.controllers.network import SectorNetwork
from shepherd_phys.learning.parts import CriticNetwork
from shepherd_phys.settings import SettingsError


class SectorFeatures(BaseFeaturesExtractor):
    """From an observation to the first wide layer; see `SectorNetwork`.

    Args:
        observation_space: "lidar", (R, C); "critic", (n,), where the critic sees the world.
        network: sizes of the groups.
        hidden: width of what it gives.
        world: width of the layer over "critic", which is joined; 0: only "lidar" is looked at.
    """

    def __init__(self, observation_space: spaces.Dict, network: SectorNetwork, hidden: int, world: int = 0) -> None:
        super().__init__(observation_space, hidden)
        rows, columns = observation_space["lidar"].shape or (0, 0)
        self._group, self._overlap = network.group, network.overlap
        self.groups = nn.Linear(rows * (network.group + 2 * network.overlap), network.features)
        joined = columns // network.group * network.features
        self.world: nn.Linear | None = None
        if world:
            (n_numbers,) = observation_space["critic"].shape or (0,)
            self.world = nn.Linear(n_numbers, world)
            joined += world
        self.hidden = nn.Linear(joined, hidden)

    def forward(self, observations: dict[str, torch.Tensor]) -> torch.Tensor:
        """(B, hidden)."""
        return self.of_groups(self.cut(observations["lidar"]), observations)

    def cut(self, lidar: torch.Tensor) -> torch.Tensor:
        """The groups (B, G, R x (group + 2 overlap)) of an observation (B, R, C): what the shared layer sees."""
        batch, rows, _ = lidar.shape
        if self._overlap:
            lidar = torch.cat((lidar[..., -self._overlap :], lidar, lidar[..., : self._overlap]), dim=-1)
        groups = lidar.unfold(2, self._group + 2 * self._overlap, self._group)  # (B, R, G, group + 2 overlap)
        return groups.transpose(1, 2).reshape(batch, groups.shape[2], rows * groups.shape[3])

    def of_groups(self, seen: torch.Tensor, observations: dict[str, torch.Tensor]) -> torch.Tensor:
        """(B, hidden) of groups that are cut already."""
        joined = torch.relu(self.groups(seen)).flatten(1)
        if self.world is not None:
            joined = torch.cat((joined, torch.relu(self.world(observations["critic"]))), dim=1)
        return torch.relu(self.hidden(joined))


class TeamPolicy(MultiInputActorCriticPolicy):
    """A policy of stable-baselines3 whose actor sees the lidar alone, and whose critic sees the world if it is given.

    Args:
        observation_space: a ``Dict`` with "lidar" and, for the critic, perhaps "critic".
        action_space: of one shepherd.
        lr_schedule: learning rate.
        network: sizes of the actor.
        critic: sizes of the critic; of both, none given: the default ones.
        options: further ones of stable-baselines3's policies, such as ``log_std_init``.

    Raises:
        SettingsError: ``use_sde`` is asked for: its standard deviations are no two numbers, and no policy file's.
    """

    def __init__(
        self,
        observation_space: spaces.Dict,
        action_space: spaces.Box,
        lr_schedule: Any,
        network: SectorNetwork | None = None,
        critic: CriticNetwork | None = None,
        **options: Any,
    ) -> None:
        if options.get("use_sde"):
            raise SettingsError("use_sde: a TeamPolicy explores without it (given: True)")
        self.network, self.critic = network or SectorNetwork(), critic or CriticNetwork()
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            features_extractor_class=SectorFeatures,
            share_features_extractor=False,
            **options,
        )

    def make_features_extractor(self) -> BaseFeaturesExtractor:
        """The actor's at the first call, the critic's at the second, as stable-baselines3 makes them."""
        space = self.observation_space
        assert isinstance(space, spaces.Dict)
        if "pi_features_extractor" not in self._modules:
            return SectorFeatures(space, self.network, self.network.hidden)
        world = self.critic.world if "critic" in space.spaces else 0
        return SectorFeatures(space, self.network, self.critic.hidden, world)

    def extract_features(  # type: ignore[override]
        self, obs: Any, features_extractor: BaseFeaturesExtractor | None = None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """The actor's and the critic's. Both cut the lidar alike: once for both, since that copies the observations."""
        actor, critic = self.pi_features_extractor, self.vf_features_extractor
        assert isinstance(actor, SectorFeatures) and isinstance(critic, SectorFeatures)
        seen = actor.cut(obs["lidar"])
        return actor.of_groups(seen, obs), critic.of_groups(seen, obs)

    def _build_mlp_extractor(self) -> None:
        heads = MlpExtractor(self.network.hidden, {"pi": [self.network.latent], "vf": []}, nn.Tanh, self.device)
        heads.value_net = nn.Sequential(nn.Linear(self.critic.hidden, self.critic.latent), nn.Tanh()).to(self.device)
        heads.latent_dim_vf = self.critic.latent
        self.mlp_extractor = heads
