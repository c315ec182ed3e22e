"""The doors of the house: which module may import which."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("shepherd_phys", "envs", "controllers", "scripts")

# A module imports from the lines above its own and from its own. Obstacles and geometry stand above the state because
# a state carries those of its world.
ORDER = (
    ("files",),
    ("settings", "cells", "neighbours", "workers", "palette", "_frames", "_motion", "_pixels", "_shapes", "_raycast"),
    ("_engine",),
    ("bodies", "obstacles"),
    ("geometry",),
    ("state",),
    ("placement", "avoidance"),
    ("layouts",),
    ("flock", "lidar"),
    ("observation",),
    ("imperfections", "mirror"),
    ("scenario",),
    ("stage",),
    ("world",),
    ("canvas", "cluster", "ledger", "replay"),
    ("campaign", "camera", "outlines", "replay_file"),
    ("overlays", "window", "film"),
    ("render",),
)
RANK = {name: rank for rank, names in enumerate(ORDER) for name in names}
TRAINING = {"torch", "stable_baselines3"}
DRAWING = {"canvas", "render", "window"}
ANALYSIS = {"matplotlib", "scipy", "polars"}
CLUSTER = {"distributed", "dask"}
# what the simulator does not import; only what analyses may wait inside a function, pygame inside one that draws, and
# distributed inside one of the cluster's
FOREIGN = {"gymnasium", "pettingzoo", "pygame", "bokeh"} | TRAINING | ANALYSIS | CLUSTER
MAY_TRAIN = ("envs/team.py", "shepherd_phys/learning/", "scripts/train.py")


def imports(tree: ast.Module, package: str) -> list[tuple[str, bool, bool]]:
    """(module.name, while the module is imported, relative) of every import in a file."""
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]
    later = {id(node) for function in functions for node in ast.walk(function)}
    found: list[tuple[str, bool, bool]] = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found += [(alias.name, id(node) not in later, False) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            module = ".".join([*base, *([node.module] if node.module else [])])
            found += [(f"{module}.{alias.name}", id(node) not in later, node.level > 0) for alias in node.names]
    return found


def violations(path: str, source: str) -> list[str]:
    """What the file at ``path``, relative to the checkout, imports and must not."""
    room, *inner = Path(path).parts[:-1]
    package = ".".join([room if room == "shepherd_phys" else f"shepherd_phys.{room}", *inner])
    stem = inner[0] if room == "shepherd_phys" and inner else Path(path).stem
    tree = ast.parse(source)
    guarded = any("TYPE_CHECKING" in ast.dump(node) for node in ast.walk(tree) if isinstance(node, ast.If))
    wrong = ["TYPE_CHECKING: the cut is wrong"] if guarded else []
    for name, at_import, relative in imports(tree, package):
        top, part, *_ = [*name.split("."), ""]
        if top in FOLDERS[1:]:
            wrong.append(f"{name}: import shepherd_phys.{top}")
        if top in TRAINING and not path.startswith(MAY_TRAIN):
            wrong.append(f"{name}: only for {', '.join(MAY_TRAIN)}")
        if top == "shepherd_phys" and part == room and not relative:
            wrong.append(f"{name}: relative within a folder")
        if relative and room != "shepherd_phys" and part != room:
            wrong.append(f"{name}: shepherd_phys.{part} across folders")
        if top == "shepherd_phys" and {part, room} == {"envs", "controllers"}:
            wrong.append(f"{name}: envs and controllers do not know each other")
        if top == "shepherd_phys" and part == "learning" and room in {"envs", "controllers"}:
            wrong.append(f"{name}: learning stands on this room")
        if top == "shepherd_phys" and part == "scripts" and room != "scripts":
            wrong.append(f"{name}: nothing imports a script")
        if room != "shepherd_phys":
            continue
        waits = not at_import and (top in ANALYSIS or (top == "pygame" and stem in DRAWING))
        waits |= not at_import and top in CLUSTER and stem == "cluster"
        if top in FOREIGN and not inner and not waits:
            wrong.append(f"{name}: not in the simulator")
        # learning alone stands on envs and controllers too
        if top == "shepherd_phys" and stem != "learning" and part in {*FOLDERS[1:], "learning"}:
            wrong.append(f"{name}: a room that stands on this one")
        if top == "shepherd_phys" and RANK.get(part, -1) > RANK.get(stem, len(ORDER)):
            wrong.append(f"{name}: comes later than {stem}")
    return wrong


def files(*folders: str) -> list[str]:
    """Paths in the checkout, tracked or about to be, as git tells them."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z", "--", *folders]
    listing = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if listing.returncode:
        pytest.skip("not a git checkout")
    return [path for path in listing.stdout.split("\0") if path and (ROOT / path).is_file()]


def test_every_import_goes_through_a_door() -> None:
    modules = [path for path in files(*FOLDERS) if path.endswith(".py")]
    assert len(modules) >= 8
    found = {path: violations(path, (ROOT / path).read_text(encoding="utf-8")) for path in modules}
    assert not {path: wrong for path, wrong in found.items() if wrong}


def test_modules_of_the_simulator_have_a_place_in_the_order() -> None:
    stems = {Path(path).stem for path in files("shepherd_phys") if path.count("/") == 1 and path.endswith(".py")}
    assert not stems - {"__init__", "_version"} - set(RANK), "give the module its place in ORDER, above"


@pytest.mark.parametrize(
    ("path", "source"),
    [
        ("shepherd_phys/flock.py", "from shepherd_phys.world import World"),
        ("shepherd_phys/flock.py", "from shepherd_phys import world"),
        ("shepherd_phys/flock.py", "from .world import World"),
        ("shepherd_phys/world.py", "import shepherd_phys.envs"),
        ("shepherd_phys/world.py", "from shepherd_phys.learning import ppo"),
        ("shepherd_phys/world.py", "def f():\n    from shepherd_phys import controllers"),
        ("shepherd_phys/world.py", "import gymnasium as gym"),
        ("shepherd_phys/world.py", "def f():\n    import pygame"),
        ("shepherd_phys/campaign.py", "import polars"),
        ("shepherd_phys/cluster.py", "import distributed"),
        ("shepherd_phys/campaign.py", "def f():\n    import distributed"),
        ("shepherd_phys/render.py", "import pygame"),
        ("shepherd_phys/render.py", "class Window:\n    import pygame"),
        ("shepherd_phys/state.py", "if typing.TYPE_CHECKING:\n    import numpy"),
        ("envs/shepherding.py", "from shepherd_phys.controllers import strombom"),
        ("envs/shepherding.py", "from ..controllers.strombom import Strombom"),
        ("envs/shepherding.py", "from shepherd_phys.envs.rewards import WILD"),
        ("envs/shepherding.py", "from envs.rewards import WILD"),
        ("envs/shepherding.py", "from ..world import World"),
        ("envs/shepherding.py", "import torch.nn"),
        ("shepherd_phys/learning/ppo.py", "from shepherd_phys.scripts import train"),
        ("controllers/base.py", "def f():\n    import stable_baselines3"),
        ("controllers/base.py", "from shepherd_phys.scripts import train"),
        ("controllers/base.py", "import scripts"),
        ("controllers/learned.py", "def f():\n    from shepherd_phys.learning import network"),
    ],
)
def test_a_forbidden_import_is_seen(path: str, source: str) -> None:
    assert violations(path, source)


@pytest.mark.parametrize(
    ("path", "source"),
    [
        ("shepherd_phys/render.py", "def f():\n    import pygame"),
        ("shepherd_phys/campaign.py", "def f():\n    import polars"),
        ("shepherd_phys/cluster.py", "def f():\n    import distributed"),
        ("shepherd_phys/world.py", "from shepherd_phys.scenario import Scenario"),
        ("shepherd_phys/learning/ppo.py", "import torch\nfrom shepherd_phys.learning.network import Network"),
        ("shepherd_phys/learning/ppo.py", "from shepherd_phys.envs.team import TeamVecEnv"),
        ("envs/team.py", "import torch\nfrom .rewards import WILD\nfrom shepherd_phys.world import World"),
        ("scripts/train.py", "import stable_baselines3\nfrom shepherd_phys.envs import team"),
    ],
)
def test_an_allowed_import_is_let_through(path: str, source: str) -> None:
    assert not violations(path, source)


def test_names_say_what_a_file_is_for() -> None:
    vague = {"utils", "util", "core", "common", "helpers", "misc"}
    assert not [path for path in files(*FOLDERS, "tests") if vague & {Path(path).stem, *Path(path).parts}]


def test_no_file_names_a_place_on_one_machine() -> None:
    place = re.compile(rb"(?<![\w.~}>/-])/(?:work|root|home|Users)/\w")
    assert place.search(b"open('/" + b"home/me/x')")
    texts = {path: (ROOT / path).read_bytes() for path in files() if path != "requirements.lock"}
    assert not [path for path, text in texts.items() if b"\0" not in text and place.search(text)]


def test_importing_the_package_is_light() -> None:
    """Numbers only: nothing that trains, draws or analyses is loaded."""
    heavy = (TRAINING | ANALYSIS | CLUSTER | {"pygame", "bokeh"}) - {
        "scipy"
    }  # numba loads scipy by itself where it is installed
    code = f"""
import sys
import shepherd_phys, shepherd_phys.envs, shepherd_phys.controllers
print(*sorted({heavy} & set(sys.modules)))
"""
    run = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    assert run.stdout.split() == []
