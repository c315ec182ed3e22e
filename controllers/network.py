"""The actor's network without torch: from one shepherd's observation to its action."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numba import njit
from numpy.typing import NDArray
from pydantic import Field

from shepherd_phys.lidar import Lidar
from shepherd_phys.settings import Settings, SettingsError, settings

Weights = Mapping[str, NDArray[np.float32]]

Size = Field(ge=1, le=4096)


@settings
class SectorNetwork(Settings):
    """Groups of neighbouring columns share one layer; then two layers over all groups, and the action.

    With R = stack x channels rows and C columns (sectors, or beams) in an observation, G = C / ``group`` groups::

        group g:  relu(W_1 x_g + b_1),  x_g the (R, overlap + group + overlap) numbers of the group and its neighbours
        hidden:   relu(W_2 [all groups] + b_2)
        latent:   tanh(W_3 . + b_3)
        action:   W_4 . + b_4, the mean of the action's distribution
        its standard deviations:  exp(log_std)

    All groups use the same W_1, as a convolution does, and beams wrap around: the neighbours of the first group are the
    last one's columns. There is no normalisation of any input.
    """

    group: int = Field(default=4, ge=1, le=4096)
    """Columns in a group."""
    overlap: int = Field(default=0, ge=0, le=64)
    """Columns on either side of a group that its layer sees besides."""
    features: int = Field(default=32, ge=1, le=4096)
    """Numbers that the shared layer makes of a group."""
    hidden: int = Field(default=192, ge=1, le=4096)
    """Width of the layer over all groups."""
    latent: int = Field(default=64, ge=1, le=4096)
    """Width of the last layer before the action."""

    def shapes(self, lidar: Lidar) -> dict[str, tuple[int, ...]]:
        """Shape of each weight by name, for observations of these lidar settings.

        Raises:
            SettingsError: the network does not fit the observation.
        """
        rows, columns = input_shape(lidar)
        if columns % self.group:
            raise SettingsError(
                f"SectorNetwork.group: must divide the {columns} columns of an observation (given: {self.group})"
            )
        if self.overlap * 2 + self.group > columns:
            raise SettingsError(
                f"SectorNetwork.overlap: a group of {self.group} with its neighbours must fit in {columns} columns "
                f"(given: {self.overlap})"
            )
        seen = rows * (self.group + 2 * self.overlap)
        groups = columns // self.group
        return {
            "groups.weight": (self.features, seen),
            "groups.bias": (self.features,),
            "hidden.weight": (self.hidden, groups * self.features),
            "hidden.bias": (self.hidden,),
            "latent.weight": (self.latent, self.hidden),
            "latent.bias": (self.latent,),
            "action.weight": (2, self.latent),
            "action.bias": (2,),
            "log_std": (2,),
        }


ARCHITECTURES: dict[str, type[SectorNetwork]] = {"SectorNetwork": SectorNetwork}
"""By name, for policy files."""


def bytes_of(shapes: Mapping[str, tuple[int, ...]]) -> int:
    """Of float32 arrays of these shapes."""
    return 4 * sum(math.prod(shape) for shape in shapes.values())


def input_shape(lidar: Lidar) -> tuple[int, int]:
    """(R, C): rows and columns of one shepherd's observation, as a network takes it.

    Raises:
        SettingsError: the observation is laid out otherwise.
    """
    if lidar.layout != "rows":
        raise SettingsError(f"Lidar.layout: a policy's network takes 'rows' (given: {lidar.layout!r})")
    _, rows, columns = lidar.observation_shape(1)
    return rows, columns


def with_channels(weights: Weights, network: SectorNetwork, lidar: Lidar, wanted: Lidar) -> Weights:
    """Weights for a lidar with more channels, which give the same actions whatever the new ones read.

    Args:
        weights: of ``network`` for observations of ``lidar``.
        network: its sizes.
        lidar: what the weights know.
        wanted: the same with further channels.

    Raises:
        SettingsError: the two lidars differ in more than that.
    """
    if lidar.but(channels=wanted.channels) != wanted or not set(lidar.channels) <= set(wanted.channels):
        raise SettingsError(f"lidar: {lidar} cannot become {wanted} by further channels")
    width = network.group + 2 * network.overlap
    known = weights["groups.weight"].reshape(network.features, lidar.stack, len(lidar.channels), width)
    wider = np.zeros((network.features, lidar.stack, len(wanted.channels), width), np.float32)
    wider[:, :, [wanted.channels.index(name) for name in lidar.channels]] = known
    return {**weights, "groups.weight": wider.reshape(network.features, -1)}


Means = NDArray[np.float32]


class Actor:
    """The network with its weights, ready to run.

    Args:
        network: its sizes.
        lidar: of the observations.
        weights: arrays of the names and shapes that ``network.shapes(lidar)`` tells.
    """

    def __init__(self, network: SectorNetwork, lidar: Lidar, weights: Weights) -> None:
        self._shape = input_shape(lidar)
        self._sizes = (network.group, network.overlap, network.features, network.hidden, network.latent)
        # a layer's weights input by input: what an input of 0 would read is not read at all; and all in one array: to
        # give compiled code an array costs time
        self._weights = np.concatenate(
            [
                array.ravel()
                for name in ("groups", "hidden", "latent", "action")
                for array in (weights[f"{name}.weight"].T, weights[f"{name}.bias"])
            ]
        )
        self.deviation = np.exp(weights["log_std"])
        """(2,) standard deviations of every action."""

    def __call__(self, observation: NDArray[np.float32], mirrored: NDArray[np.bool_] | None = None) -> Means:
        """Means (P, 2), not clipped, of the actions for P observations (P, R, C) float32.

        Those of whom ``mirrored`` (P,) is true see theirs as `shepherd_phys.mirror.seen` shows it: columns are read the
        other way round, which costs less than turning them.
        """
        if observation.shape[1:] != self._shape:
            raise ValueError(
                f"observation: needs the shape (P, {self._shape[0]}, {self._shape[1]}), has {observation.shape}"
            )
        if mirrored is None:
            mirrored = np.zeros(len(observation), np.bool_)
        means = np.empty((len(observation), 2), np.float32)
        _forward(np.ascontiguousarray(observation, np.float32), mirrored, self._sizes, self._weights, means)
        return means


@njit(cache=True, error_model="numpy")
def _forward(observation, mirrored, sizes, numbers, means):  # type: ignore[no-untyped-def]
    """Write the means (P, 2) as `SectorNetwork` says.

    ``numbers`` are the weights of each layer, input by input, and its bias.

    Most of what a lidar observes is 0, and so is half of what a relu gives: both are skipped. Rows of arrays are taken
    out of the loops over their numbers, which makes these twice as fast.
    """
    n, rows, columns = observation.shape
    group, overlap, features, n_hidden, n_latent = sizes
    groups, width = columns // group, group + 2 * overlap
    w1, b1, numbers = _taken(numbers, rows * width, features)
    w2, b2, numbers = _taken(numbers, groups * features, n_hidden)
    w3, b3, numbers = _taken(numbers, n_hidden, n_latent)
    w4, b4, _ = _taken(numbers, n_latent, 2)
    reach = (overlap + group - 1) // group
    shared = np.empty((n, groups, features), np.float32)
    shared[:] = b1
    for p in range(n):
        for r in range(rows):
            seen = observation[p, r]
            for c in range(columns):
                x = seen[columns - c if mirrored[p] and c > 0 else c]
                if x != 0.0:
                    for near in range(c // group - reach, c // group + reach + 1):
                        k = c - near * group + overlap
                        if 0 <= k < width:
                            _add(shared[p, near % groups], x, w1[r * width + k])
    hidden = _layer(shared.reshape(n, groups * features), w2, b2)
    latent = _layer(hidden, w3, b3)
    for p in range(n):
        x, y = b4[0], b4[1]
        for j in range(len(b3)):
            z = np.tanh(latent[p, j])
            x += z * w4[j, 0]
            y += z * w4[j, 1]
        means[p, 0], means[p, 1] = x, y


@njit(cache=True, error_model="numpy")
def _taken(numbers, inputs, outputs):  # type: ignore[no-untyped-def]
    """The weights (inputs, outputs) and the bias (outputs,) of a layer, and the numbers of those after it."""
    n = inputs * outputs
    return numbers[:n].reshape(inputs, outputs), numbers[n : n + outputs], numbers[n + outputs :]


@njit(cache=True, error_model="numpy")
def _layer(inputs, weights, bias):  # type: ignore[no-untyped-def]
    """Bias + relu(inputs) @ weights; four inputs at a time, since the way to memory is what takes time."""
    out = np.empty((len(inputs), len(bias)), np.float32)
    out[:] = bias
    lit = np.empty(inputs.shape[1], np.int64)
    for p in range(len(out)):
        row, total, n = inputs[p], out[p], 0
        for j in range(len(row)):
            if row[j] > 0.0:
                lit[n] = j
                n += 1
        for q in range(0, n - n % 4, 4):
            a, b, c, d = lit[q], lit[q + 1], lit[q + 2], lit[q + 3]
            xa, xb, xc, xd = row[a], row[b], row[c], row[d]
            wa, wb, wc, wd = weights[a], weights[b], weights[c], weights[d]
            for i in range(len(total)):
                total[i] += xa * wa[i] + xb * wb[i] + xc * wc[i] + xd * wd[i]
        for q in range(n - n % 4, n):
            _add(total, row[lit[q]], weights[lit[q]])
    return out


@njit(cache=True, error_model="numpy")
def _add(out, x, weights):  # type: ignore[no-untyped-def]
    """Add x weights."""
    for i in range(len(out)):
        out[i] += x * weights[i]
