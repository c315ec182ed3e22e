"""`save_replay`, `load_replay`: a zip of plain arrays and one JSON table, which ``numpy.load`` opens too.

| member | what |
|---|---|
| ``header.json`` | format, version, checksum, controller, scenario, seed, obstacles with their outlines |
| ``sheep_pos.npy`` .. | a field of `WorldState` of this name: of `CHANGING` with T + 1 rows, of `CONSTANT` as it is |
| ``actions.npy`` | (T, P, 2) float64 |
| ``rewards.npy`` | (T, K) float64, the K terms that the header names |

Everything is float64 as it was computed, but truth values and ``collisions`` (int64). To be exact costs room: the last
bits are noise, which no compression takes away, so 1,000 steps of 100 sheep take about 4 MB of 6. Shuffled bytes,
differences and LZMA would save a tenth more (measured) and cost every reader a decoder.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import zipfile
import zlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shepherd_phys.files import whole_file
from shepherd_phys.obstacles import OBSTACLES, Obstacle, Outline, outlines
from shepherd_phys.replay import CHANGING, CONSTANT, Replay, ReplayError, Stored
from shepherd_phys.scenario import Scenario
from shepherd_phys.settings import Foreign, SettingsError, handed_over, kind_of, tagged, untagged
from shepherd_phys.state import frozen

FORMAT = "shepherd_phys replay"
FORMAT_VERSION = 1
HEADER = "header.json"
MAX_HEADER = 1 << 26
"""[bytes] of the header."""
MAX_BYTES = 1 << 30
"""[bytes] of the arrays together, unpacked: what claims more is refused before anything is unpacked."""
MAX_COUNT = 10_000_000
"""Of steps, sheep and shepherds: so large a number is a claim and no episode."""
NPY_HEADER = 1024
"""[bytes] that an array's own header may have."""
DAMAGED = (
    zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, KeyError, TypeError, ValueError,
    OverflowError, RecursionError,
)  # fmt: skip
"""What reading a file that is none raises in ``zipfile``, ``json`` and NumPy."""

Layout = Mapping[str, tuple[str, tuple[int, ...]]]
"""Name of an array -> its dtype and shape."""


def save_replay(replay: Replay, path: str | Path) -> None:
    """Write a replay to a file, which appears whole or not at all; the same episode gives the same bytes.

    Raises:
        ReplayError: it cannot be written; the message names the file.
    """
    path = Path(path)
    t, n, p = replay.n_steps, replay.n_sheep, replay.n_shepherds
    rewards = np.stack(list(replay.rewards.values()), axis=1) if replay.rewards else np.empty((t, 0))
    arrays = {**replay.constants, **replay.states, "actions": replay.actions, "rewards": rewards}
    layout = layout_of(t, n, p, len(replay.rewards))
    try:
        header = {
            "format": FORMAT,
            "format_version": FORMAT_VERSION,
            "version": replay.version,
            "controller": replay.controller,
            "parameters": dict(replay.parameters),
            "scenario_name": replay.scenario_name,
            "scenario": replay.scenario.to_dict(),
            "seed": replay.seed,
            "n_steps": t,
            "n_sheep": n,
            "n_shepherds": p,
            "rewards": list(replay.rewards),
            "obstacles": [_described(thing, i) for i, thing in enumerate(replay.obstacles)],
        }
        packed = {name: np.ascontiguousarray(arrays[name], dtype=dtype) for name, (dtype, _) in layout.items()}
        wrong = _implausible(packed, layout)
        if wrong is not None:
            raise ReplayError(f"{path}: cannot be written: {wrong}")
        header["checksum"] = checksum(header, packed)
        text = json.dumps(header, indent=1, allow_nan=False, ensure_ascii=True).encode()
    except (SettingsError, TypeError, ValueError) as error:
        message = str(error) if isinstance(error, ReplayError) else f"{path}: cannot be written ({error})"
        raise ReplayError(message) from None
    try:
        with whole_file(path) as part, zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED) as archive:
            _put(archive, HEADER, text)
            for name, array in packed.items():
                member = io.BytesIO()
                np.lib.format.write_array(member, array, version=(1, 0), allow_pickle=False)
                _put(archive, f"{name}.npy", member.getvalue())
    except OSError as error:
        raise ReplayError(f"{path}: cannot be written ({error.strerror})") from None


def load_replay(path: str | Path, classes: Iterable[Any] = ()) -> Replay:
    """Read what `save_replay` wrote. Nothing in a file is ever run or imported.

    Args:
        path: of the file.
        classes: a user's own classes of bodies, flock models, obstacles and layouts. Without them everything can be
            looked at, but not played again by `Replay.verify`.

    Raises:
        ReplayError: the file is missing, damaged, of another version or none of ours; the message names it.
    """
    path = Path(path)
    try:
        with path.open("rb") as file, zipfile.ZipFile(file) as archive:
            header = _header(archive)
            layout = _claimed(header)
            arrays = _arrays(archive, layout)
        if checksum(header, arrays) != header.get("checksum"):
            raise ReplayError("is damaged: its checksum is another one")
        return _made(header, arrays, tuple(classes))
    except OSError as error:
        raise ReplayError(f"{path}: cannot be read ({error.strerror or error})") from None
    except (ReplayError, SettingsError) as error:
        raise ReplayError(f"{path}: {error}") from None
    except DAMAGED as error:
        said = " ".join(str(error).split())[:200] or type(error).__name__
        raise ReplayError(f"{path}: is not a whole replay ({said})") from None


def layout_of(t: int, n: int, p: int, k: int) -> Layout:
    """The arrays of T steps, N sheep, P shepherds and K reward terms."""
    number, truth = "<f8", "|b1"
    return {
        "goal_pos": (number, (2,)),
        "sheep_radius": (number, (n,)),
        "sheep_max_speed": (number, (n,)),
        "shepherd_radius": (number, (p,)),
        "shepherd_max_speed": (number, (p,)),
        "sheep_pos": (number, (t + 1, n, 2)),
        "sheep_vel": (number, (t + 1, n, 2)),
        "sheep_heading": (number, (t + 1, n, 2)),
        "sheep_goal_distance": (number, (t + 1, n)),
        "sheep_in_goal": (truth, (t + 1, n)),
        "sheep_arrived": (truth, (t + 1, n)),
        "shepherd_pos": (number, (t + 1, p, 2)),
        "shepherd_vel": (number, (t + 1, p, 2)),
        "shepherd_angle": (number, (t + 1, p)),
        "shepherd_path": (number, (t + 1, p)),
        "collisions": ("<i8", (t + 1,)),
        "actions": (number, (t, p, 2)),
        "rewards": (number, (t, k)),
    }


def checksum(header: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> str:
    """SHA-256 of a header, the checksum itself excepted, and of the arrays in their order."""
    known = {name: value for name, value in header.items() if name != "checksum"}
    digest = hashlib.sha256(json.dumps(known, sort_keys=True, ensure_ascii=True, allow_nan=False).encode())
    for name, array in arrays.items():
        digest.update(name.encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


# --- writing ---


def _described(thing: Any, index: int) -> dict[str, Any]:
    """An obstacle, and how it looks to those who have not got its class."""
    shown = [[outline.points.tolist(), outline.radius] for outline in outlines(thing, index)]
    return {"is": tagged(thing), "outlines": shown}


def _put(archive: zipfile.ZipFile, name: str, content: bytes) -> None:
    """Add a member without the hour, so that the same episode gives the same bytes."""
    member = zipfile.ZipInfo(name)
    member.compress_type = zipfile.ZIP_DEFLATED
    archive.writestr(member, content)


# --- reading ---


def _header(archive: zipfile.ZipFile) -> dict[str, Any]:
    """The table, of a format that can be read."""
    names = archive.namelist()
    if HEADER not in names:
        raise ReplayError("is not a replay of shepherd_phys")
    header = json.loads(_unpacked(archive, HEADER, MAX_HEADER))
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise ReplayError("is not a replay of shepherd_phys")
    if header.get("format_version") != FORMAT_VERSION:
        found = str(header.get("format_version"))[:20]
        raise ReplayError(f"is a replay of format {found}; this version reads format {FORMAT_VERSION}")
    return header


def _claimed(header: Mapping[str, Any]) -> Layout:
    """The arrays that there must be, if the header is right."""
    counts = [header.get(name) for name in ("n_steps", "n_sheep", "n_shepherds")]
    least = (1, 1, 0)
    if not all(
        type(count) is int and low <= count <= MAX_COUNT  # a bool is no count
        for count, low in zip(counts, least, strict=True)
    ):
        raise ReplayError("is damaged: n_steps, n_sheep and n_shepherds must be whole numbers that an episode can have")
    terms = header.get("rewards")
    if not isinstance(terms, list) or not all(isinstance(name, str) for name in terms) or len(set(terms)) < len(terms):
        raise ReplayError("is damaged: rewards must be a list of different names")
    t, n, p = (int(str(count)) for count in counts)
    layout = layout_of(t, n, p, len(terms))
    size = sum(np.dtype(dtype).itemsize * math.prod(shape) for dtype, shape in layout.values())
    if size > MAX_BYTES:
        raise ReplayError(f"claims to hold {size / 1e9:.1f} GB; at most {MAX_BYTES / 1e9:.1f} GB are read")
    return layout


def _arrays(archive: zipfile.ZipFile, layout: Layout) -> dict[str, NDArray[Any]]:
    """All arrays, of the right kind, shape and size, finite."""
    wanted = sorted([HEADER, *(f"{name}.npy" for name in layout)])
    if sorted(archive.namelist()) != wanted:
        raise ReplayError("is damaged: it holds other arrays than a replay does")
    arrays = {name: _array(archive, name, dtype, shape) for name, (dtype, shape) in layout.items()}
    wrong = _implausible(arrays, layout)
    if wrong is not None:
        raise ReplayError(f"is damaged: {wrong}")
    return arrays


def _array(archive: zipfile.ZipFile, name: str, dtype: str, shape: tuple[int, ...]) -> NDArray[Any]:
    """One array; what its own header says is compared and not followed."""
    size = np.dtype(dtype).itemsize * math.prod(shape)
    content = io.BytesIO(_unpacked(archive, f"{name}.npy", size + NPY_HEADER))
    if np.lib.format.read_magic(content) != (1, 0):
        raise ReplayError(f"is damaged: {name} is of another version of NumPy's format")
    said = np.lib.format.read_array_header_1_0(content, max_header_size=NPY_HEADER)
    data = content.read()
    if said != (shape, False, np.dtype(dtype)) or len(data) != size:
        raise ReplayError(f"is damaged: {name} must be {dtype} of shape {shape} (found: {said[2]} of {said[0]})")
    if dtype == "|b1" and np.frombuffer(data, np.uint8).max(initial=0) > 1:
        raise ReplayError(f"is damaged: {name} holds what is neither true nor false")
    return frozen(np.frombuffer(data, dtype).reshape(shape))


def _unpacked(archive: zipfile.ZipFile, name: str, most: int) -> bytes:
    """A member, of at most so many bytes, whatever it claims."""
    with archive.open(name) as member:
        content = member.read(most + 1)
        if len(content) > most:
            raise ReplayError(f"is damaged: {name} is larger than it can be")
    return content


def _implausible(arrays: Mapping[str, NDArray[Any]], layout: Layout) -> str | None:
    """What no episode has: another shape, or a number that is not finite."""
    for name, (_, shape) in layout.items():
        if arrays[name].shape != shape:
            return f"{name} needs shape {shape} (given: {arrays[name].shape})"
        if arrays[name].dtype.kind == "f" and not np.isfinite(arrays[name]).all():
            return f"{name} holds a number that is not finite"
    return None


def _made(header: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]], classes: tuple[Any, ...]) -> Replay:
    """The replay of a header and its arrays."""
    texts = {name: header.get(name) for name in ("controller", "scenario_name", "version")}
    tables = {name: header.get(name) for name in ("parameters", "scenario")}
    things, seed = header.get("obstacles"), header.get("seed")
    if not all(isinstance(text, str) for text in texts.values()):
        raise ReplayError(f"is damaged: {', '.join(texts)} must be text")
    if not all(isinstance(table, dict) for table in tables.values()) or not isinstance(things, list):
        raise ReplayError(f"is damaged: {' and '.join(tables)} must be tables, obstacles a list")
    if type(seed) is not int or seed < 0:
        raise ReplayError("is damaged: the seed must be a whole number that is not negative")
    scenario = Scenario.from_dict(dict(tables["scenario"] or {}), classes)
    if (scenario.n_sheep, scenario.n_shepherds) != (header["n_sheep"], header["n_shepherds"]):
        raise ReplayError("is damaged: its scenario has other numbers of sheep or shepherds than its arrays")
    return Replay(
        controller=str(texts["controller"]),
        parameters=dict(tables["parameters"] or {}),
        scenario_name=str(texts["scenario_name"]),
        scenario=scenario,
        seed=seed,
        version=str(texts["version"]),
        obstacles=tuple(_obstacle(thing, i, handed_over(classes)) for i, thing in enumerate(things)),
        constants={name: arrays[name] for name in CONSTANT},
        states={name: arrays[name] for name in CHANGING},
        actions=arrays["actions"],
        rewards={name: frozen(arrays["rewards"][:, k].copy()) for k, name in enumerate(header["rewards"])},
    )


def _obstacle(described: Any, index: int, own: Mapping[str, Any]) -> Obstacle:
    """An obstacle; of a class that was not handed over, what is known of it."""
    where = f"obstacles[{index}]"
    if not isinstance(described, dict) or set(described) != {"is", "outlines"}:
        raise ReplayError(f"is damaged: {where} must be a table with 'is' and 'outlines'")
    made = untagged(described["is"], OBSTACLES | dict(own), where)
    if isinstance(made, Foreign):
        made = Stored(
            made.kind, made.values, tuple(Outline(points, radius) for points, radius in described["outlines"])
        )
    outlines(made, index)  # what has no shapes, or impossible ones, is told now
    if not isinstance(made, Obstacle):
        raise ReplayError(f"is damaged: {where} ({kind_of(made)}) is no obstacle")
    return made
