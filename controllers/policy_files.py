"""Policy files: NAME.json, what a policy is, beside NAME.safetensors, its weights.

Both are plain data, and reading them runs nothing: no pickle, no import. Whatever is wrong with them is one
`PolicyError`. Names of a user's own classes (``module:Name``) stay text.
"""

from __future__ import annotations

import hashlib
import json
import math
import stat
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import safetensors
import safetensors.numpy
from numpy.typing import NDArray
from pydantic import Field

from shepherd_phys import __version__, mirror
from shepherd_phys.files import whole_file
from shepherd_phys.lidar import Lidar
from shepherd_phys.mirror import Side
from shepherd_phys.scenario import Scenario
from shepherd_phys.settings import Settings, SettingsError, settings, tagged, untagged

from .hold import Hold, check_sight
from .network import ARCHITECTURES, SectorNetwork, bytes_of
from .wander import Wander

FORMAT = "shepherd_phys policy"
FORMAT_VERSION = 1
MAX_JSON = 1 << 20
"""Largest description that is read [bytes]."""
MAX_WEIGHTS = 1 << 26
"""Largest weights that are read [bytes]."""
MAX_FRAMES = 1 << 22
"""Most numbers in the remembered frames of a shepherd: 2,048 frames of 4 channels and 512 beams."""
HEADER = 1 << 16
"""What a safetensors file may hold beside its numbers [bytes]."""


class PolicyError(SettingsError):
    """A policy file is missing, damaged or not one; the message names it and what is wrong."""


@settings
class Acting(Settings):
    """How a policy's output becomes an action when it is deployed."""

    frame: Literal["world", "goal"] = "world"
    """Axes of its output: the world's, or those of the goal frame, from which it is turned back. The lidar's frame."""
    interval: int = Field(default=1, ge=1, le=1000)
    """Control steps for which a decision is held."""
    rest: float = Field(default=0.0, ge=0, lt=1)
    """Wanted speeds below this part of the top speed mean standing still: an output that is never quite 0 creeps tens
    of metres in an episode."""
    noise: float = Field(default=0.0, ge=0, le=1)
    """Standard deviations of its distribution by which actions scatter: 0: its mean, 1: as while learning. Shepherds
    of one mind that see the same may all wait for one another for good; chance ends that."""
    noise_steps: int = Field(default=5, ge=1, le=1000)
    """Control steps for which what chance adds is held; while learning those of a decision."""
    mirror: Side = "never"
    """Which shepherds see the world in a mirror."""
    hold: Hold | None = None
    """How a team holds the herd once it is home; none: as the policy wants, like all the time before."""
    wander: Wander | None = None
    """What a shepherd does whose policy gets it nowhere; none: it waits."""

    def check(self, lidar: Lidar) -> None:
        """Find out whether somebody with this lidar can act so.

        Raises:
            SettingsError: it cannot; the message begins with the field.
        """
        if self.frame != lidar.frame:
            raise SettingsError(f"frame: must be the lidar's, {lidar.frame!r} (given: {self.frame!r})")
        mirror.check(self.mirror, lidar)
        for name in ("hold", "wander"):
            if getattr(self, name) is not None:
                check_sight(lidar, name)


@dataclass(frozen=True)
class PolicySpec:
    """What a policy's JSON file says: everything but the weights."""

    scenario: Scenario
    """The world in which it was trained; objects of a user's own classes are `Foreign` unless handed over."""
    lidar: Lidar
    """What it observes."""
    network: SectorNetwork
    action: Acting
    rewards: Mapping[str, Any] = field(default_factory=dict)
    """What it was trained for, as plain data."""
    training: Mapping[str, Any] = field(default_factory=dict)
    """How it was trained, as plain data."""

    def __post_init__(self) -> None:
        try:
            self.action.check(self.lidar)
        except SettingsError as error:
            raise PolicyError(f"action.{error}") from None


FIELDS = ("format", "format_version", "version", "scenario", "lidar", "network", "action", "rewards", "training",
          "weights_sha256", "checksum")  # fmt: skip


def write_policy(path: str | Path, spec: PolicySpec, weights: Mapping[str, NDArray[np.float32]]) -> str:
    """Write NAME.json and NAME.safetensors; each appears whole or not at all.

    Args:
        path: NAME.json.
        spec: what the policy is.
        weights: arrays of the names and shapes that the network tells.

    Returns:
        the checksum that identifies the policy.

    Raises:
        PolicyError: they do not fit one another, hold a number that is not finite, or cannot be written.
    """
    path = _checked_path(path)
    with _told_of(path):
        weights = checked_weights(weights, spec)
        _check_size(spec)
    blob = safetensors.numpy.save({name: np.ascontiguousarray(array) for name, array in weights.items()})
    table: dict[str, Any] = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "version": __version__,
        "scenario": spec.scenario.to_dict(),
        "lidar": spec.lidar.to_dict(),
        "network": tagged(spec.network),
        "action": spec.action.to_dict(),
        "rewards": dict(spec.rewards),
        "training": dict(spec.training),
        "weights_sha256": hashlib.sha256(blob).hexdigest(),
    }
    try:
        table["checksum"] = _checksum(table)
        text = (json.dumps(table, indent=1, allow_nan=False) + "\n").encode()
    except (TypeError, ValueError) as error:
        raise PolicyError(f"{path}: what describes the policy must be plain, finite data ({error})") from None
    if len(text) > MAX_JSON:
        raise PolicyError(f"{path}: what describes the policy is of {len(text)} bytes; at most {MAX_JSON} are read")
    try:
        # the weights first: a JSON file that is there finds its weights, unless it is replacing an older pair
        for file, content in ((path.with_suffix(".safetensors"), blob), (path, text)):
            with whole_file(file) as part:
                part.write_bytes(content)
    except OSError as error:
        raise PolicyError(f"{path}: cannot be written ({error.strerror})") from None
    return str(table["checksum"])


def read_policy(
    path: str | Path, classes: Iterable[Any] = ()
) -> tuple[PolicySpec, dict[str, NDArray[np.float32]], str]:
    """Read a policy and check all of it.

    Args:
        path: NAME.json; NAME.safetensors stands beside it.
        classes: a user's own classes that its scenario names. Nothing is ever imported by name.

    Returns:
        what it is, its weights by name, and the checksum that identifies it.

    Raises:
        PolicyError: something is missing, damaged or not allowed.
    """
    path = _checked_path(path)
    table = _parsed(_read(path, MAX_JSON), path)
    try:
        spec = _spec(table, classes)
        size = _check_size(spec)
    except SettingsError as error:
        raise PolicyError(f"{path}: {_brief(str(error))}") from None
    except (TypeError, ValueError, OverflowError, RecursionError) as error:
        raise PolicyError(f"{path}: is not a policy ({_brief(str(error))})") from None
    beside = path.with_suffix(".safetensors")
    blob = _read(beside, size + HEADER)
    if hashlib.sha256(blob).hexdigest() != table["weights_sha256"]:
        raise PolicyError(f"{beside}: is damaged, or not the one that belongs to {path.name} (checksums differ)")
    try:
        weights = safetensors.numpy.load(blob)
    except (safetensors.SafetensorError, KeyError, TypeError, ValueError) as error:
        raise PolicyError(f"{beside}: is not a safetensors file ({_brief(str(error))})") from None
    with _told_of(beside):
        return spec, checked_weights(weights, spec), str(table["checksum"])


def _spec(table: Mapping[str, Any], classes: Iterable[Any]) -> PolicySpec:
    return PolicySpec(
        scenario=Scenario.from_dict(_table(table, "scenario"), classes),
        lidar=Lidar(**_table(table, "lidar")),
        network=_network(_table(table, "network")),
        action=Acting(**_table(table, "action")),
        rewards=_table(table, "rewards"),
        training=_table(table, "training"),
    )


def _network(table: Mapping[str, Any]) -> SectorNetwork:
    network = untagged(table, ARCHITECTURES, "network")
    if not isinstance(network, SectorNetwork):  # module:Name
        raise PolicyError(f"network.kind: {_brief(repr(table['kind']))} is unknown; known: {', '.join(ARCHITECTURES)}")
    return network


def _table(table: Mapping[str, Any], name: str) -> dict[str, Any]:
    if not isinstance(table[name], dict):
        raise PolicyError(f"{name}: must be a table (given: {_brief(repr(table[name]))})")
    return dict(table[name])


def _parsed(blob: bytes, path: Path) -> dict[str, Any]:
    """The JSON file as a table whose fields are there and whose checksum is right."""
    try:
        table = json.loads(blob.decode("utf-8"), object_pairs_hook=_once, parse_constant=_refused, parse_float=_finite)
    except (ValueError, RecursionError) as error:  # not UTF-8 is a ValueError, too
        raise PolicyError(f"{path}: is not a JSON file ({_brief(str(error))})") from None
    if not isinstance(table, dict) or table.get("format") != FORMAT:
        raise PolicyError(f"{path}: is not a policy file (format is not {FORMAT!r})")
    if table.get("format_version") != FORMAT_VERSION:
        raise PolicyError(
            f"{path}: format_version: this version of shepherd_phys reads {FORMAT_VERSION} "
            f"(given: {_brief(repr(table.get('format_version')))})"
        )
    unknown = [name for name in table if name not in FIELDS]
    missing = [name for name in FIELDS if name not in table]
    if unknown or missing:
        what = f"unknown field {_brief(repr(unknown[0]))}" if unknown else f"no field {missing[0]!r}"
        raise PolicyError(f"{path}: {what}; a policy has {', '.join(FIELDS)}")
    given = table["checksum"]
    try:
        checksum = _checksum({name: value for name, value in table.items() if name != "checksum"})
    except RecursionError:  # what can be read need not be shallow enough to be written
        raise PolicyError(f"{path}: is nested too deeply") from None
    if given != checksum:
        raise PolicyError(f"{path}: was changed after it was written (its checksum is wrong)")
    return table


def _checksum(table: Mapping[str, Any]) -> str:
    """SHA-256 of everything the JSON file says, the weights' own checksum included."""
    text = json.dumps(table, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    table = dict(pairs)
    if len(table) != len(pairs):
        raise ValueError("a field is given twice")
    return table


def _refused(name: str) -> Any:
    raise ValueError(f"{name} is no number")


def _finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"{_brief(text)} is no finite number")
    return number


def checked_weights(weights: Mapping[str, NDArray[np.float32]], spec: PolicySpec) -> dict[str, NDArray[np.float32]]:
    """The weights, if they are those that the network needs, each of its shape, float32 and finite.

    Raises:
        PolicyError: they are not.
        SettingsError: the network does not fit the lidar.
    """
    shapes = spec.network.shapes(spec.lidar)
    for name in weights:
        if name not in shapes:
            raise PolicyError(f"unknown weight {_brief(repr(name))}; there are {', '.join(shapes)}")
    for name, shape in shapes.items():
        if name not in weights:
            raise PolicyError(f"no weight {name!r}; there are {', '.join(shapes)}")
        array = weights[name]
        if array.dtype != np.float32 or array.shape != shape:
            raise PolicyError(f"{name}: must be float32 {shape} (given: {array.dtype} {array.shape})")
        if not np.isfinite(array).all():
            raise PolicyError(f"{name}: holds a NaN or an infinity")
    return dict(weights)


def _check_size(spec: PolicySpec) -> int:
    """Bytes of the weights.

    Raises:
        PolicyError: a file with so many, or whose policy would remember so much, is not read.
    """
    size = bytes_of(spec.network.shapes(spec.lidar))
    if size > MAX_WEIGHTS:
        raise PolicyError(f"network: {size} bytes of weights; at most {MAX_WEIGHTS} are read")
    kept = spec.lidar.remembered
    if kept > MAX_FRAMES:
        raise PolicyError(f"lidar: {kept} numbers of frames to remember a shepherd; at most {MAX_FRAMES}")
    return size


@contextmanager
def _told_of(path: Path) -> Iterator[None]:
    """Put the file's name before what is said of what is in it."""
    try:
        yield
    except PolicyError as error:
        raise PolicyError(f"{path}: {error}") from None


def _checked_path(path: str | Path) -> Path:
    path = Path(path)
    if path.suffix != ".json":
        raise PolicyError(f"{path}: a policy is named by its .json file; its .safetensors file stands beside it")
    return path


def _read(path: Path, most: int) -> bytes:
    """All of a regular file, if it is no larger than ``most`` bytes."""
    try:
        if not stat.S_ISREG(path.stat().st_mode):  # a pipe or a device would block, or never end
            raise PolicyError(f"{path}: is not a regular file")
        with path.open("rb") as file:
            blob = file.read(most + 1)
    except OSError as error:
        raise PolicyError(f"{path}: cannot be read ({error.strerror})") from None
    except ValueError as error:  # a null byte in the name
        raise PolicyError(f"{_brief(repr(str(path)))}: cannot be read ({error})") from None
    if len(blob) > most:
        raise PolicyError(f"{path}: is larger than the {most} bytes that a policy may have here")
    return blob


def _brief(text: str) -> str:
    """One printable line of at most 200 characters: what it quotes may be anything."""
    line = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    return line if len(line) <= 200 else line[:197] + "..."
