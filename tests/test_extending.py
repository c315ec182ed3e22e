"""The guide's examples of extending: short blocks, all in one file in a folder of its own, on the command line."""

import csv
import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import tomli_w
from test_docs import ROOT, blocks

from shepherd_phys.controllers import load_policy
from shepherd_phys.learning.preset import Preset
from shepherd_phys.scripts.evaluate import main as evaluate
from shepherd_phys.scripts.train import main as train
from shepherd_phys.settings import Foreign
from shepherd_phys.world import World

PAGE = ROOT / "docs" / "extending.md"
MARK = "# my_file.py\n"
MINE = [block.removeprefix(MARK) for block in blocks(PAGE, "python") if block.startswith(MARK)]
COMMAND = Path(sys.executable).with_name("shepherd-phys")
QUICK = tomllib.loads(blocks(PAGE, "toml")[0])
TINY = {
    **QUICK,
    "worlds": 2,
    "team_sizes": [2],
    "budget": 2_400,
    "checkpoint_rollouts": 15,  # of 2 worlds x 2 shepherds x 8 decisions x 5 control steps = 160
    "scenario": {"n_sheep": 6, "n_flocks": 2, "shepherds": 2, "n_steps": 60},
    "ppo": {"n_steps": 8, "batch_size": 16, "n_epochs": 1},
}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder away from the checkout, with a user's one file."""
    (tmp_path / "my_file.py").write_text("\n".join(MINE), encoding="utf-8")
    (tmp_path / "tiny.toml").write_text(tomli_w.dumps(TINY["scenario"]))
    (tmp_path / "hexapod.toml").write_text(tomli_w.dumps(TINY))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [p for p in sys.path if p not in ("", str(ROOT))])
    yield tmp_path
    sys.modules.pop("my_file", None)


def shell(line):
    done = subprocess.run([COMMAND, *line.split()], capture_output=True, text=True, timeout=1800, check=False)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr


def rows():
    with open("results/episodes.csv", newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_an_example_is_a_few_lines_and_there_is_one_of_each():
    for block in MINE:
        assert len([line for line in block.splitlines() if line.strip()]) <= 15
    text = "\n".join(MINE)
    for what in ("def build", "def act", "def velocities", "def shapes", "after, scan, scenario", "FIELD = SCENARIOS"):
        assert text.count(what) == 1


def test_everything_of_a_users_own_plays_by_its_name(folder):
    shell("evaluate --controllers my_file:ChaseFarthest --scenario my_file:FIELD --trials 1 --workers 1")
    (row,) = rows()
    assert (row["controller"], row["scenario"], row["n_shepherds"]) == ("my_file:ChaseFarthest", "my_file:FIELD", "3")
    assert row["cohesion"] == ""


def test_a_policy_for_a_users_body_is_trained_and_played_from_the_command_line(folder, capsys):
    shell("train --preset hexapod.toml --body my_file:Hexapod --out runs/hexapod --workers 2")
    told = json.loads(Path("runs/hexapod/best.json").read_text())
    assert {body["kind"] for body in told["scenario"]["shepherds"]} == {"my_file:Hexapod"}
    policy = load_policy("runs/hexapod/best.json")  # imports nothing
    assert isinstance(policy.spec.scenario.shepherds[0], Foreign) and "my_file" not in sys.modules
    assert policy.spec.training["shepherd_steps"] > 2_000

    again = ["--resume", "--out", "runs/hexapod", "--budget", "4800", "--workers", "1"]
    assert train(again) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "'my_file:Hexapod' is a class of somebody's own and was not handed over" in line
    assert train([*again, "--body", "my_file:Hexapod"]) == 0
    from my_file import Hexapod

    assert load_policy("runs/hexapod/policy.json", [Hexapod]).spec.scenario.shepherds == (Hexapod(),) * 2
    assert load_policy("runs/hexapod/policy.json").spec.training["shepherd_steps"] > 4_000

    shell(
        "evaluate --controllers runs/hexapod/best.json idle --body my_file:Hexapod --flock my_file:Skittish "
        "--scenario tiny.toml --trials 1 --workers 1"
    )
    assert {row["controller"] for row in rows()} == {"runs/hexapod/best.json", "idle"}


def test_a_policy_is_trained_in_a_scenario_of_a_users_own_classes_and_goes_on(folder, capsys):
    Path("mine.py").write_text(
        "from my_file import *\n"
        "class Lazy:\n"  # no dataclass: two of it are not equal
        "    def velocities(self, state, rng): return 0.2 * state.sheep_heading\n"
        "STREWN = FIELD.but(n_sheep=6, n_steps=60, layout=Crosses(2), flock=Lazy())\n"
    )
    own = ["--scenario", "mine:STREWN", "--reward", "my_file:CALM", "--out", "runs/strewn", "--workers", "1"]
    assert train(["--preset", "hexapod.toml", *own]) == 0
    assert train(["--resume", "--budget", "4800", "--out", "runs/strewn", "--workers", "1"]) == 2
    assert "is a class of somebody's own and was not handed over" in capsys.readouterr().err
    assert train(["--resume", "--budget", "4800", "--out", "runs/strewn", "--scenario", "mine:STREWN"]) == 2
    assert "'my_file:calm' is a class of somebody's own and was not handed over" in capsys.readouterr().err
    assert train(["--resume", "--budget", "4800", *own]) == 0
    policy = load_policy("runs/strewn/policy.json")
    assert policy.spec.training["shepherd_steps"] > 4_000
    assert policy.spec.lidar.channels[-1] == "obstacles"
    terms = policy.spec.rewards["terms"]
    assert terms["calm"] == {"weight": -0.05, "term": {"kind": "my_file:calm"}} and len(terms) == 4
    sys.modules.pop("mine")


def test_a_flock_model_of_a_users_own_may_be_a_function(folder, capsys):
    Path("mine.py").write_text("def still(state, rng): return 0.0 * state.sheep_pos\nSTILL = 3\n")
    words = "--controllers idle --scenario tiny.toml --trials 1 --workers 1 --flock mine:"
    shell(f"evaluate {words}still")
    assert [(row["cohesion"], row["ever_in_goal"]) for row in rows()] == [("", "0.0")]
    assert evaluate([*f"{words}STILL".split(), "--out", "other"]) == 2
    assert "flock: mine:STILL: needs a class or a function (its type: int)" in capsys.readouterr().err
    sys.modules.pop("mine")


def test_the_guides_preset_is_one(folder):
    preset = Preset.from_dict(QUICK)
    assert (preset.n_slots, preset.budget) == (48, 50_000)


@pytest.mark.slow
def test_the_guides_preset_trains_as_printed_and_what_it_made_plays(folder):
    Path("quick.toml").write_text(blocks(PAGE, "toml")[0])
    shell("train --preset quick.toml --body my_file:Hexapod --out runs/quick --workers 2")
    assert load_policy("runs/quick/policy.json").spec.training["shepherd_steps"] >= 50_000
    shell("evaluate --controllers runs/quick/best.json --body my_file:Hexapod --trials 2 --workers 2")
    assert [row["n_shepherds"] for row in rows()] == ["3", "3"]


BROKEN = """
from shepherd_phys.bodies import Disc
from shepherd_phys.scenario import SCENARIOS

class Stone:
    max_speed = 1.0
class Stuck(Disc):
    def follow(self, pose, wanted): return wanted, 0.0
class Ghost(Disc):
    def build(self): return None
class Bomb(Disc):
    def build(self): raise OSError("no parts")
class Buoy(Disc):
    def build(self):
        body, shapes = Disc.build(self)
        shapes[0].sensor = True
        return body, shapes
class Deaf:
    def hear(self): ...
class Secretive:
    def __init__(self): self.mood = 3
    def velocities(self, state, rng): return 0.0 * state.sheep_pos
class Sea:
    def shapes(self, body): raise OSError("no shore")
def fog(rng, site): raise OSError("no light")
def sour(before, after, scan, scenario): raise OSError("no taste")
SOUR = {"sour": (1.0, sour)}
BLAND = {"bland": sour}
number = 3
FLOODED = SCENARIOS["small"].but(obstacles=(Sea(),))
FOGGY = SCENARIOS["small"].but(layout=fog)
"""


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ("--body my_file:Stone", "body: my_file:Stone: lacks build, follow"),
        ("--body my_file:Stuck", "my_file:Stuck.follow: is called with (pose, wanted, dt); this one takes ("),
        ("--body my_file:Ghost", "shepherd 0 (my_file:Ghost).build: needs a pymunk.Body and a list of its shapes"),
        ("--body my_file:Bomb", "OSError: no parts (my_file.py:"),
        ("--body my_file:Buoy", "(my_file:Buoy).build: a Circle is a sensor, which touches nothing and no beam sees"),
        ("--scenario my_file:FLOODED", "OSError: no shore (my_file.py:"),
        ("--scenario my_file:FOGGY", "OSError: no light (my_file.py:"),
        ("--flock my_file:Secretive", "my_file:Secretive: cannot be written, because it does not say"),
        ("--reward my_file:number", "reward: my_file:number: needs a scheme, a dict of name -> (weight, term)"),
        ("--reward my_file:BLAND", "reward: my_file:BLAND: rewards['bland']: needs a number and a term"),
        ("--reward my_file:SOUR", "OSError: no taste (my_file.py:"),
        ("--reward sweet", "reward: 'sweet' is not one of original, any, wild"),
        ("--body my_file:number", "body: my_file:number: needs a class (its type: int)"),
        ("--body my_file:Nobody", "body: my_file:Nobody: module 'my_file' has no 'Nobody'"),
        ("--body Tank", "body: 'Tank' is unknown; there are DifferentialDrive, Disc, Flyer"),
        ("--flock my_file:Deaf", "flock: my_file:Deaf: lacks velocities"),
    ],
)
def test_train_tells_in_one_line_what_a_class_lacks_and_makes_no_folder(flags, message, folder, capsys):
    Path("my_file.py").write_text(BROKEN)
    assert train(["--preset", "hexapod.toml", "--out", "runs/x", *flags.split()]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("shepherd-phys train: ") and message in line
    assert not Path("runs").exists()


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ("--body my_file:Bomb", "OSError: no parts (my_file.py:"),
        ("--scenario my_file:FLOODED", "OSError: no shore (my_file.py:"),
        ("--scenario my_file:FOGGY", "OSError: no light (my_file.py:"),
    ],
)
def test_evaluate_tells_in_one_line_what_fails_at_a_reset(flags, message, folder, capsys):
    Path("my_file.py").write_text(BROKEN)
    assert evaluate(["--controllers", "idle", "--out", "results", *flags.split()]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("shepherd-phys evaluate: ") and message in line
    assert not Path("results").exists()


def test_the_guides_layout_ends_where_there_is_no_room(folder):
    sys.path.append(str(folder))
    from my_file import CROSSED, Crosses

    state = World(CROSSED.but(layout=Crosses(count=10_000))).reset(0)
    assert 4 < len(state.obstacles) < 200


def test_a_preset_with_neighbours_to_draw_draws_none_for_a_flock_model_without(folder):
    Path("hexapod.toml").write_text(tomli_w.dumps({**TINY, "n_neighbours": [3, 9], "budget": 160}))
    assert train(["--preset", "hexapod.toml", "--flock", "Reynolds", "--out", "runs/x", "--workers", "1"]) == 0
    assert Preset.from_toml("runs/x/preset.toml").n_neighbours is None
    with open("runs/x/validation.csv", newline="", encoding="utf-8") as file:
        assert {row["cohesion"] for row in csv.DictReader(file)} == {""}


def test_a_body_that_fails_while_learning_is_one_line(folder, capsys):
    Path("late.py").write_text(
        "from my_file import Hexapod\n\n\nclass Late(Hexapod):\n    made = 0\n\n"
        "    def follow(self, *call):\n        Late.made += 1\n        if Late.made > 300:\n"
        "            raise ZeroDivisionError('tired')\n        return super().follow(*call)\n"
    )
    Path("hexapod.toml").write_text(tomli_w.dumps({**TINY, "budget": 160}))
    assert train(["--preset", "hexapod.toml", "--body", "late:Late", "--out", "runs/x", "--workers", "1"]) == 1
    *_, line = capsys.readouterr().err.splitlines()
    assert re.match(
        r"shepherd-phys train: ZeroDivisionError: tired \(late.py:10\), in world \d, episode seed \d+$", line
    )
