"""``shepherd-phys evaluate`` from the outside: tables, JSON, continuing, shards, grids, and every mistake."""

import csv
import importlib.util
import io
import json
import math
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import tomli_w
from hypothesis import given, settings
from hypothesis import strategies as st

from shepherd_phys import __version__, campaign
from shepherd_phys.bodies import Disc
from shepherd_phys.campaign import Ledger
from shepherd_phys.controllers.evaluation import COLUMNS, METRICS, trial_seed
from shepherd_phys.controllers.network import SectorNetwork
from shepherd_phys.controllers.policy_files import Acting, PolicySpec, write_policy
from shepherd_phys.controllers.summary import difference_columns, summary_columns
from shepherd_phys.layouts import Scattered
from shepherd_phys.lidar import Lidar
from shepherd_phys.scenario import SCENARIOS
from shepherd_phys.scripts import command, evaluate, main, pictures
from shepherd_phys.scripts.campaigns import _are_compiled
from shepherd_phys.scripts.evaluate import GRID_KEYS, LISTS, read_options, read_shard
from shepherd_phys.scripts.points import points, strangers
from shepherd_phys.settings import SettingsError

TINY = {"n_sheep": 6, "n_flocks": 2, "shepherds": 2, "n_steps": 6}
HERD = {
    **TINY,
    "shepherds": [{"kind": "mine:Cart", "size": 0.3}, {"kind": "mine:Cart", "size": 0.2, "max_speed": 2.0}],
    "flock": {"kind": "mine:Crowd", "pace": 0.25},
}
BOULDER = {"kind": "Wall", "start": [-90.0, 0.0], "end": [90.0, 0.0], "thickness": 180.0}
"""No world can be placed round it."""
COMMAND = Path(sys.executable).with_name("shepherd-phys")

MINE = """
from dataclasses import dataclass

import numpy as np
import pymunk
from shepherd_phys.bodies import Disc
from shepherd_phys.flock import Strombom

print("a module that prints")

class Chase:
    lidar = None
    def reset(self, rng): pass
    def act(self, observation, state):
        print("a controller that prints")
        away = state.sheep_pos.mean(axis=0) - state.shepherd_pos
        return away / np.linalg.norm(away, axis=1, keepdims=True)

class Bad(Chase):
    def act(self, observation, state): return np.full((state.n_shepherds, 2), np.nan)

class Faint(Chase):
    def reset(self, rng):
        if rng.random() < 0.5: raise RuntimeError("not today")

class Half:
    lidar = None
    def reset(self, rng): pass

class Odd(Chase):
    def to_dict(self): return {"rng": object()}

class Loud(Chase):
    def __init__(self): print("a controller that prints when it is made")
    def reset(self, rng): print("and when it begins")

class Bell(Disc):
    def build(self):
        print("a body that prints when it is built")
        return super().build()

@dataclass(frozen=True)
class Cart:
    size: float
    max_speed: float = 1.2
    def __post_init__(self):
        if self.size < 0: raise ValueError("a cart has a size")
    def build(self):
        body = pymunk.Body(1.0, 1.0)
        return body, [pymunk.Circle(body, self.size)]
    def follow(self, pose, wanted, dt): return wanted, 0.0

@dataclass(frozen=True)
class Crowd:
    n_neighbours: int = 4
    pace: float = 0.5
    def velocities(self, state, rng): return np.full((state.n_sheep, 2), self.pace)

@dataclass(frozen=True)
class Post:
    x: float = 9.0
    def shapes(self, body): return [pymunk.Circle(body, 0.5, (self.x, 0.0))]

class Moody:
    def __init__(self): self.mood = 0.3
    def velocities(self, state, rng): return np.zeros((state.n_sheep, 2))

class Slim(Disc): pass
class Shy(Strombom): pass
class Stone:
    max_speed = 1.0
class Free:
    def velocities(self, state, rng): return np.zeros((state.n_sheep, 2))
class Needy(Disc):
    def __init__(self, what): pass
class Late(Chase):
    def __init__(self): 1 / 0
class Heavy(Disc):
    def __init__(self, **values): raise RuntimeError("too heavy")
class Stuck(Disc):
    def follow(self, pose, wanted): return wanted, 0.0
class Dizzy(Disc):
    def follow(self, pose, wanted, dt): return wanted, float("nan")
class Lost(Free):
    def velocities(self, state, rng): return np.zeros(2)
class Wild:
    def __init__(self): raise RuntimeError("too wild")
def maker(): raise KeyError("no")
def ask(n): return None
def cold(state): return 0.0 * state.sheep_pos
def strewn():
    from shepherd_phys.scenario import Scenario
    return Scenario(n_sheep=6, layout=lambda rng: [])
def junk():
    from shepherd_phys.scenario import Scenario
    return Scenario(n_sheep=6, layout=litter)
def litter(rng, site): return [1, 2]
number = 3
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A working directory with a tiny scenario and a user's module."""
    (tmp_path / "tiny.toml").write_text(tomli_w.dumps(TINY))
    (tmp_path / "mine.py").write_text(MINE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    yield tmp_path
    sys.modules.pop("mine", None)


def shell(words, timeout=300):
    return subprocess.run([COMMAND, *words.split()], capture_output=True, text=True, timeout=timeout)


@pytest.fixture
def in_process(monkeypatch):
    """No worker processes: each takes seconds to start."""
    monkeypatch.setattr(campaign, "run", partial(campaign.run, retries=0))
    monkeypatch.setitem(evaluate.LEAST, "workers", 0)


def run(*words, workers=0):
    return main.main(["evaluate", "--scenario", "tiny.toml", "--trials", "2", "--workers", str(workers), *words])


def mistakes(err):
    """Lines on standard error but for the progress of a slow machine and for what the user's module prints."""
    usual = ("a module that", "compiling the kernels")
    return [line for line in err.splitlines() if " episodes: " not in line and not line.startswith(usual)]


def read(path):
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


# ---- what it writes -----------------------------------------------------------------------------------------------


def test_the_command_in_a_shell(folder):
    done = shell(
        "evaluate --scenario tiny.toml --controllers idle strombom --flocks 1 2 --cohesion 3 5 --shepherds 1 2 "
        "--trials 2 --workers 2"
    )
    assert done.returncode == 0, done.stderr
    names = ["episodes.csv", "episodes.parquet", "summary.csv", "differences.csv", "episode.png"]
    if not importlib.util.find_spec("polars"):
        names.remove("episodes.parquet")
    assert done.stdout.splitlines()[-len(names) :] == [f"results/{name}" for name in names]
    assert "difference from idle on the same seeds" in done.stdout
    assert "in at the end %" in done.stdout
    rows = read("results/episodes.csv")
    assert tuple(rows[0]) == COLUMNS
    assert len(rows) == 2 * 2 * 2 * 2 * 2
    seen = {tuple(row[name] for name in COLUMNS[:4]) for row in rows}
    assert seen == {(c, k, n, m) for c in ("idle", "strombom") for k in "12" for n in "35" for m in "12"}
    assert {row["seed"] for row in rows} == {str(trial_seed(20_000, i)) for i in (0, 1)}
    assert {(row["scenario"], row["n_sheep"], row["steps"], row["version"]) for row in rows} == {
        ("tiny.toml", "6", "6", __version__)
    }
    assert len({row["settings_hash"] for row in rows}) == 16
    summary = read("results/summary.csv")
    assert tuple(summary[0]) == summary_columns()
    assert len(summary) == 16
    assert Path("results/episode.png").read_bytes().startswith(b"\x89PNG")
    assert mistakes(done.stderr) == []


@pytest.mark.slow
def test_json_is_all_that_there_is_on_standard_output(folder):
    done = shell("evaluate --scenario tiny.toml --controllers mine:Chase idle --trials 2 --workers 1 --json --out o")
    assert done.returncode == 0, done.stderr
    rows = json.loads(done.stdout)
    assert [row["controller"] for row in rows] == ["idle", "mine:Chase"]
    for row in rows:
        assert (row["n_flocks"], row["cohesion"], row["n_shepherds"], row["trials"]) == (2, 40, 2, 2)
        for name in METRICS:
            assert row[f"{name}_low"] <= row[f"{name}_mean"] <= row[f"{name}_high"]
    assert [row["differences"] is None for row in rows] == [False, True]  # mine:Chase is the first
    assert "o/summary.csv" in done.stderr


def test_nothing_of_a_users_gets_onto_standard_output(folder, in_process, capsys):
    own = ["--controllers", "mine:Loud", "--body", "mine:Bell"]
    assert run(*own, "--json") == 0
    said = capsys.readouterr()
    assert [row["controller"] for row in json.loads(said.out)] == ["mine:Loud"]
    for line in ("prints when it is made", "and when it begins", "a body that prints when it is built"):
        assert line in said.err
    assert run(*own) == 0
    out = capsys.readouterr().out
    assert "in at the end %" in out and "print" not in out and "and when" not in out


def test_tables_do_not_depend_on_workers_order_or_interruption(folder, in_process):
    assert run("--controllers", "idle", "random", "--out", "a", workers=0) == 0
    assert run("--controllers", "random", "idle", "--out", "b", workers=2) == 0
    with Ledger("b", __version__) as ledger:  # as a run that was killed half-way leaves it
        ledger._rows.execute("DELETE FROM episodes WHERE seed = ?", (trial_seed(20_000, 1),))
    assert run("--controllers", "idle", "random", "--out", "b", workers=1) == 0
    for name in ("episodes.csv", "summary.csv", "differences.csv"):
        assert Path("a", name).read_bytes() == Path("b", name).read_bytes()


def test_a_finished_campaign_runs_nothing(folder, in_process, monkeypatch, capsys):
    assert run("--controllers", "idle") == 0
    first = {path.name: path.read_bytes() for path in Path("results").iterdir()}
    monkeypatch.setattr("shepherd_phys.campaign.attempt", None)
    monkeypatch.setattr("shepherd_phys.scripts.pictures.draw_episode", None)
    assert run("--controllers", "idle") == 0
    assert {path.name: path.read_bytes() for path in Path("results").iterdir()} == first
    assert mistakes(capsys.readouterr().err) == []


def test_more_trials_keep_the_earlier_ones(folder, in_process):
    assert run("--controllers", "idle") == 0
    two = read("results/episodes.csv")
    assert run("--controllers", "idle", "--trials", "4") == 0
    four = read("results/episodes.csv")
    assert [row for row in four if row in two] == two


def test_an_edited_class_does_not_find_the_rows_of_the_old_one(folder):
    hashes = []
    for source in (MINE, MINE.replace("away /", "-away /")):
        Path("mine.py").write_text(source)
        sys.modules.pop("mine", None)
        hashes.append(points(controllers=["mine:Chase"], scenario="tiny.toml")[0].settings_hash())
    assert hashes[0] != hashes[1]


def test_settings_hash_tells_everything_apart_but_the_scenarios_name(folder):
    def hash_of(**changes):
        return points(**{"controllers": ["idle"], "scenario": "tiny.toml", **changes})[0].settings_hash()

    Path("same.toml").write_text(tomli_w.dumps(TINY))
    assert hash_of() == hash_of(scenario="same.toml") == hash_of(flocks=[2])
    changes = [{}, {"flocks": [1]}, {"cohesion": [3]}, {"shepherds": [1]}, {"sheep": 5}, {"controllers": ["random"]}]
    changes += [{"body": "mine:Slim"}, {"flock": "mine:Shy"}]
    assert len({hash_of(**change) for change in changes}) == len(changes)


def test_a_users_own_body_and_flock(folder, in_process):
    assert run("--controllers", "mine:Chase", "--body", "mine:Slim", "--flock", "mine:Shy", "--cohesion", "4") == 0
    assert {(row["controller"], row["cohesion"]) for row in read("results/episodes.csv")} == {("mine:Chase", "4")}
    assert run("--controllers", "idle", "--flock", "mine:Free") == 0
    assert {row["cohesion"] for row in read("results/episodes.csv")} == {""}


def test_a_users_own_classes_keep_the_parameters_of_the_file(folder, in_process):
    Path("herd.toml").write_text(tomli_w.dumps(HERD))
    own = ["--scenario", "herd.toml", "--body", "mine:Cart", "--flock", "mine:Crowd"]
    assert run(*own, "--controllers", "idle") == 0  # a Cart cannot even be made without arguments
    (point,) = points(controllers=["idle"], scenario="herd.toml", body="mine:Cart", flock="mine:Crowd")
    assert [(body.size, body.max_speed) for body in point.scenario.shepherds] == [(0.3, 1.2), (0.2, 2.0)]
    assert (point.scenario.flock.pace, point.scenario.flock.n_neighbours) == (0.25, 4)
    assert {row["settings_hash"] for row in read("results/episodes.csv")} == {point.settings_hash()}
    (point,) = points(controllers=["idle"], scenario="herd.toml", body="Disc", flock="mine:Crowd", cohesion=[3])
    assert point.scenario.shepherds == (Disc(), Disc())
    assert (point.scenario.flock.pace, point.scenario.flock.n_neighbours) == (0.25, 3)


def test_bodies_of_another_kind_become_the_one_asked_for(folder):
    bodies = [{"kind": "Disc", "radius": 0.4}, {"kind": "mine:Slim", "radius": 0.3}]
    Path("mixed.toml").write_text(tomli_w.dumps({**TINY, "shepherds": bodies}))
    (point,) = points(controllers=["idle"], scenario="mixed.toml", body="mine:Slim")
    assert [(type(body).__name__, body.radius) for body in point.scenario.shepherds] == [("Slim", 0.25), ("Slim", 0.3)]
    Path("none.toml").write_text(tomli_w.dumps({**TINY, "shepherds": 0}))
    (point,) = points(controllers=["idle"], scenario="none.toml", body="mine:Slim", shepherds=[2])
    assert [type(body).__name__ for body in point.scenario.shepherds] == ["Slim", "Slim"]


def test_a_world_without_shepherds(folder, in_process, capsys):
    assert run("--controllers", "idle", "random", "strombom", "--shepherds", "0", "1", "--json") == 0
    rows = [row for row in json.loads(capsys.readouterr().out) if row["n_shepherds"] == 0]
    assert [row["controller"] for row in rows] == ["idle", "random", "strombom"]
    for row in rows:
        assert row["path_length_mean"] == row["path_length_high"] == row["collisions_mean"] == 0
        assert all(math.isfinite(row[f"{name}_{part}"]) for name in METRICS for part in ("mean", "low", "high"))


def test_shards_make_up_the_whole(folder, in_process):
    words = ["--controllers", "idle", "random", "--trials", "3"]
    assert run(*words, "--out", "whole") == 0
    parts = []
    for i in "1234":
        assert run(*words, "--out", i, "--shard", f"{i}/4") == 0
        parts += read(f"{i}/episodes.csv")
    key = lambda row: (row["controller"], int(row["seed"]))  # noqa: E731
    assert sorted(parts, key=key) == read("whole/episodes.csv")


def test_shards_gathered_are_the_whole(folder, in_process, monkeypatch):
    words = ["--controllers", "idle", "random", "--trials", "3"]
    assert run(*words, "--out", "whole") == 0
    for i in "12":
        assert run(*words, "--out", i, "--shard", f"{i}/2") == 0
    monkeypatch.setattr("shepherd_phys.campaign.attempt", None)
    assert run(*words, "--gather", "1", "2", "--out", "all") == 0
    tables = [path.name for path in Path("whole").iterdir() if not path.name.startswith("ledger")]
    assert {"episodes.csv", "summary.csv", "differences.csv"} <= set(tables)
    for name in tables:
        assert Path("all", name).read_bytes() == Path("whole", name).read_bytes()


def test_differences_are_paired_with_the_baseline(folder, in_process, capsys):
    words = ["--controllers", "idle", "random", "mine:Chase", "--flocks", "1", "2", "--json"]
    assert run(*words, "--baseline", "random") == 0
    rows = json.loads(capsys.readouterr().out)
    episodes = {(row["controller"], row["n_flocks"], row["seed"]): row for row in read("results/episodes.csv")}
    for row in rows:
        told = row["differences"]
        if row["controller"] == "random":
            assert told is None
            continue
        assert (told["baseline"], told["trials"]) == ("random", 2)
        by_hand = [
            float(own["path_length"]) - float(episodes["random", flocks, seed]["path_length"])
            for (name, flocks, seed), own in episodes.items()
            if (name, flocks) == (row["controller"], str(row["n_flocks"]))
        ]
        assert told["path_length_diff_mean"] == pytest.approx(sum(by_hand) / 2)
        assert told["path_length_diff_low"] <= told["path_length_diff_mean"] <= told["path_length_diff_high"]
    table = read("results/differences.csv")
    assert tuple(table[0]) == difference_columns()
    assert [(row["controller"], row["n_flocks"], row["baseline"]) for row in table] == [
        (name, flocks, "random") for name in ("idle", "mine:Chase") for flocks in "12"
    ]


def test_the_baseline_is_the_first_controller_and_pairs_are_of_seeds_that_both_have(folder, in_process, capsys):
    assert run("--controllers", "random", "mine:Faint", "--trials", "8", "--json") == 1
    rows = {row["controller"]: row for row in json.loads(capsys.readouterr().out)}
    assert 0 < rows["mine:Faint"]["trials"] < 8 == rows["random"]["trials"]
    assert rows["random"]["differences"] is None
    assert rows["mine:Faint"]["differences"]["baseline"] == "random"
    assert rows["mine:Faint"]["differences"]["trials"] == rows["mine:Faint"]["trials"]


def test_without_a_row_of_the_baseline_there_are_no_differences(folder, in_process, capsys):
    assert run("--controllers", "mine:Bad", "idle", "--json") == 1
    (row,) = json.loads(capsys.readouterr().out)
    assert (row["controller"], row["differences"]) == ("idle", None)
    assert Path("results/differences.csv").read_text() == ",".join(difference_columns()) + "\n"


def test_tables_of_an_earlier_command_do_not_stay(folder, in_process, monkeypatch, capsys):
    assert run("--controllers", "random", "idle") == 0
    assert Path("results/differences.csv").exists()
    monkeypatch.setitem(sys.modules, "polars", None)
    capsys.readouterr()
    assert run("--controllers", "idle") == 0
    assert not Path("results/differences.csv").exists()
    assert not Path("results/episodes.parquet").exists()
    assert "difference" not in capsys.readouterr().out


def test_parquet_is_the_same_table(folder, in_process):
    polars = pytest.importorskip("polars")
    assert run("--controllers", "idle", "random") == 0
    frame = polars.read_parquet("results/episodes.parquet")
    rows = read("results/episodes.csv")
    assert tuple(frame.columns) == COLUMNS
    assert [tuple(campaign._cell(cell) for cell in row) for row in frame.rows()] == [tuple(r.values()) for r in rows]
    assert frame.schema["seed"] == polars.Int64 and frame.schema["success"] == polars.Boolean
    first = Path("results/episodes.parquet").read_bytes()
    assert run("--controllers", "idle", "random", "--out", "again") == 0
    assert Path("again/episodes.parquet").read_bytes() == first


def test_a_shard_may_be_empty(folder, in_process, capsys):
    assert run("--controllers", "idle", "--trials", "2", "--shard", "3/3", "--json") == 0
    assert json.loads(capsys.readouterr().out) == []
    assert read("results/episodes.csv") == []


def test_failed_episodes_are_named_and_the_others_complete(folder, in_process, capsys):
    assert run("--controllers", "idle", "mine:Bad") == 1
    said = capsys.readouterr()
    lines = mistakes(said.err)
    assert len(lines) == 2
    for line, seed in zip(lines, (trial_seed(20_000, 0), trial_seed(20_000, 1)), strict=True):
        assert f"mine:Bad, n_flocks 2, cohesion 40, n_shepherds 2, n_sheep 6, scenario tiny.toml, seed {seed}: " in line
        assert "ControllerError: controller mine:Bad, step 0: the action holds a NaN" in line
    assert {row["controller"] for row in read("results/episodes.csv")} == {"idle"}


def test_without_any_episode_there_is_no_table(folder, in_process, capsys):
    assert run("--controllers", "mine:Bad") == 1
    said = capsys.readouterr()
    assert said.out == ""
    assert len(mistakes(said.err)) == 2
    assert read("results/episodes.csv") == []  # and none of an earlier run stays


def test_a_policy_that_was_trained_elsewhere_is_told_of(folder, in_process, capsys):
    lidar, network = Lidar(beams=32, sectors=8), SectorNetwork(features=2, hidden=2, latent=2)
    rng = np.random.default_rng(0)
    weights = {name: rng.normal(size=shape).astype(np.float32) for name, shape in network.shapes(lidar).items()}
    trained = SCENARIOS["paper"].but(n_sheep=6, shepherds=1, n_flocks=1, layout=Scattered(count=12))
    write_policy("mine.json", PolicySpec(trained, lidar, network, Acting(), {}, {}), weights)
    told = "mine.json was trained in another scenario (6 sheep, Scattered(count=12)); this is paper"
    played = partial(points, controllers=["mine.json", "idle"], flocks=[1, 2])
    (line,) = strangers(played())
    assert line.startswith(told)
    assert "(Scattered(count=12))" in strangers(played(sheep=6))[0] and "(Scat" in strangers(played(sheep=9))[0]
    usual = PolicySpec(SCENARIOS["paper"].but(n_flocks=1), lidar, network, Acting(), {}, {})
    write_policy("usual.json", usual, weights)
    assert strangers(points(controllers=["usual.json"], flocks=[3], shepherds=[1], cohesion=[5], sheep=9)) == []
    assert run("--controllers", "mine.json") == 0  # the scenario is named
    assert mistakes(capsys.readouterr().err) == []


def test_a_note_of_evaluate_goes_to_standard_error(folder, monkeypatch, capsys):
    monkeypatch.setattr(evaluate, "strangers", lambda grid: [f"{point.scenario_name} is strange" for point in grid])
    assert main.main(["evaluate", "--controllers", "idle", "--workers", "1", "--out", "tiny.toml"]) == 2
    assert mistakes(capsys.readouterr().err)[0] == "shepherd-phys evaluate: paper is strange"


def test_compiled_kernels_are_found_where_numba_keeps_them(folder, in_process, monkeypatch, tmp_path):
    assert run("--controllers", "idle", "--out", "a") == 0
    assert _are_compiled()
    kept = SimpleNamespace(stats=SimpleNamespace(cache_path=str(tmp_path / "empty")))
    monkeypatch.setattr("shepherd_phys.scripts.campaigns.neighbours.surroundings", kept)
    assert not _are_compiled()


def test_a_campaign_that_goes_on_says_so(monkeypatch, capsys):
    monkeypatch.setattr(command, "LOG_SECONDS", -1.0)
    for done, pace in ((0, "starting"), (3, "continuing, 3 of 16 there")):
        with command.progress_bar() as report:
            report(campaign.Progress(16, done, 0))
        assert f"{done}/16 episodes: {pace}\n" in capsys.readouterr().err


def test_without_pygame_there_is_no_picture(folder, in_process, monkeypatch, capsys):
    monkeypatch.setattr(pictures.importlib.util, "find_spec", lambda name: None)
    assert run("--controllers", "idle") == 0
    said = capsys.readouterr()
    assert "pygame-ce is missing" in said.err
    assert not Path("results/episode.png").exists()


def test_ctrl_c_ends_cleanly_and_says_how_to_go_on(folder):
    words = "evaluate --scenario tiny.toml --controllers random --workers 1 --trials 100000"
    with subprocess.Popen(
        [COMMAND, *words.split()], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as command:
        for _ in range(1200):
            if Path("results/ledger.sqlite-wal").exists() and Path("results/ledger.sqlite-wal").stat().st_size > 50_000:
                break
            time.sleep(0.05)
        command.send_signal(signal.SIGINT)
        out, err = command.communicate(timeout=60)
    assert command.returncode == 130
    assert out == ""
    (said,) = mistakes(err)
    assert said.startswith("shepherd-phys evaluate: stopped; what was done is kept in results:")
    with Ledger("results", __version__) as ledger:
        assert ledger._rows.execute("SELECT count(*) FROM episodes").fetchone()[0] > 0


# ---- grids --------------------------------------------------------------------------------------------------------


def test_a_grid_file_is_the_same_as_flags(folder):
    grid = {"controllers": ["idle", "random"], "flocks": [1, 2], "cohesion": [3], "trials": 7, "sheep": 5, "seed": 9}
    Path("grid.toml").write_text(tomli_w.dumps(grid))
    from_grid = read_options(["--grid", "grid.toml", "--shepherds", "1"])
    flags = "--controllers idle random --flocks 1 2 --cohesion 3 --trials 7 --sheep 5 --seed 9 --shepherds 1"
    from_flags = read_options(flags.split())
    assert {name: getattr(from_grid, name) for name in GRID_KEYS} == {n: getattr(from_flags, n) for n in GRID_KEYS}


VALUES = {
    "controllers": st.lists(st.sampled_from(["idle", "random", "strombom"]), min_size=1, max_size=4),
    "flocks": st.lists(st.integers(1, 6), min_size=1, max_size=4),
    "cohesion": st.lists(st.integers(1, 99), min_size=1, max_size=4),
    "shepherds": st.lists(st.integers(1, 4), min_size=1, max_size=4),
}


@settings(deadline=None)
@given(st.fixed_dictionaries({}, optional=VALUES))
def test_points_are_the_full_cross_product_without_repeats(lists):
    found = points(**{"controllers": ["idle"], **lists})
    expected = 1
    for values in lists.values():
        expected *= len(set(values))
    assert len(found) == expected
    assert len({json.dumps(point.labels) for point in found}) == expected
    for name, label in zip(LISTS, ("controller", "n_flocks", "cohesion", "n_shepherds"), strict=True):
        if name in lists:
            assert {point.labels[label] for point in found} == set(lists[name])


def test_a_world_that_cannot_be_placed_is_one_error(folder, in_process, capsys):
    assert run("--controllers", "idle") == 0  # a ledger that is there stays
    capsys.readouterr()
    before = Path("results/episodes.csv").read_bytes()
    Path("tiny.toml").write_text(tomli_w.dumps({**TINY, "obstacles": [BOULDER]}))
    for out in ("results", "deep/er"):
        assert run("--controllers", "idle", "--out", out) == 2
        said = capsys.readouterr()
        assert said.out == ""
        assert len(mistakes(said.err)) == 1
    assert Path("results/episodes.csv").read_bytes() == before
    assert not Path("deep").exists()
    Ledger("results", __version__).close()  # free again


# ---- mistakes -----------------------------------------------------------------------------------------------------

MISTAKES = [
    ("--controllers nobody", "controllers: 'nobody' is unknown; there are any, collie, collie-obstacles, elfiqi, "),
    ("--controllers", "--controllers: needs at least one value"),
    ("--controllers mine:Half", "controller Half: lacks act; a controller has lidar"),
    ("--controllers mine:Odd", "parameters must be plain data"),
    ("--controllers mine:Nobody", "controllers: mine:Nobody: module 'mine' has no 'Nobody'"),
    ("--controllers nowhere:X", "module 'nowhere' cannot be imported: ModuleNotFoundError"),
    ("--controllers mine:number", "controller int: lacks lidar and reset and act"),
    ("--controllers mine:Late", "controller Late: cannot be made: ZeroDivisionError: division by zero (mine.py:"),
    ("--controllers mine:maker", "controllers: mine:maker: cannot be made: KeyError: 'no' (mine.py:"),
    ("--body mine:Heavy", "body: mine:Heavy: cannot be made: RuntimeError: too heavy (mine.py:"),
    ("--flock mine:Wild", "flock: mine:Wild: cannot be made: RuntimeError: too wild (mine.py:"),
    ("--scenario heavy.toml --body mine:Heavy", "Scenario.shepherds[0]: mine:Heavy: RuntimeError: too heavy"),
    ("--controllers leaves:X", "controllers: leaves:X: module 'leaves' cannot be imported: SystemExit: 3"),
    ("--baseline random", "baseline: 'random' is not among the controllers (strombom)"),
    ("--grid base.toml", "baseline: 'nobody' is not among the controllers (strombom)"),
    ("--workers 1 --scheduler tcp://127.0.0.1:1", "--workers and --scheduler: the workers are the cluster's then"),
    ("--gather", "--gather: needs at least one value"),
    ("--gather nowhere", "nowhere: has no ledger to gather from"),
    ("--gather other", "other/ledger.sqlite: holds rows of shepherd_phys 0.0.0, this is"),
    ("--flocks 0", "flocks: 0 is impossible; it must be at least 1"),
    ("--flocks abc", "['abc']; --flocks takes whole numbers"),
    ("--flocks", "--flocks: needs at least one value"),
    ("--flocks 7", "n_flocks is 7, more than there are sheep (6)"),
    ("--cohesion -1", "cohesion"),
    ("--cohesion 3 --flock mine:Free", "cohesion: the flock model mine:Free has no n_neighbours to set (given: 3)"),
    ("--shepherds -1", "shepherds"),
    ("--shepherds 99999", "Scenario.shepherds"),
    ("--sheep 0", "sheep: 0 is impossible; it must be at least 1"),
    ("--trials 0", "trials: 0 is impossible; it must be at least 1"),
    ("--trials many", "; --trials takes a whole number"),
    ("--trials", "--trials"),
    ("--seed -5", "seed"),
    ("--workers 0", "workers: 0 is impossible; it must be at least 1"),
    ("--timeout 0", "timeout: 0.0 is impossible; it must be above 0 s"),
    ("--timeout nan", "timeout: nan is impossible"),
    ("--scheduler nonsense", "scheduler: 'nonsense' is no address; it must be like tcp://HOST:PORT"),
    ("--shard 0/3", "shard: '0/3' is impossible; it must be I/N"),
    ("--shard 4/3", "shard: '4/3' is impossible; it must be I/N"),
    ("--shard half", "shard: 'half' is impossible; it must be I/N"),
    ("--scenario mine:number", "scenario: mine:number: needs a Scenario (given: 3)"),
    ("--scenario mine:maker", "scenario: mine:maker: cannot be made: KeyError: 'no' (mine.py:"),
    ("--scenario mine:ask", "scenario: mine:ask: is called with (); this one takes (n)"),
    ("--scenario mine:strewn", "): is called with (rng, site); this one takes (rng)"),
    ("--scenario mine:junk", "layout (mine:litter) drew obstacles[0] (builtins:int): an obstacle needs 'shapes'"),
    ("--flock mine:cold", "flock (mine:cold): is called with (state, rng); this one takes (state)"),
    ("--scenario nowhere", "scenario: 'nowhere' is neither a .toml file nor one of paper"),
    ("--scenario nowhere.toml", "nowhere.toml: cannot be read (No such file or directory)"),
    ("--scenario bad.toml", "bad.toml: is not a TOML file"),
    ("--scenario odd.toml", "odd.toml: Scenario.n_shep: there is no such field (given: 3); did you mean n_sheep?"),
    ("--scenario many.toml", "many.toml: Scenario.a, b, c and 2 more: there are no such fields; fields are n_sheep, "),
    ("--scenario preset.toml", "preset.toml: is a training preset; its scenario is the table [scenario]"),
    ("--scenario fense", "; did you mean fence?"),
    (
        "--body nobody",
        "body: 'nobody' is unknown; there are DifferentialDrive, Disc, Flyer, PolygonRobot, Unicycle, or",
    ),
    ("--body mine:Stone", "body: mine:Stone: lacks build, follow"),
    ("--body mine:Needy", "body: mine:Needy: cannot be made without arguments"),
    ("--body mine:number", "body: mine:number: needs a class (its type: int)"),
    ("--flock nobody", "flock: 'nobody' is unknown; there are"),
    ("--flock mine:Stone", "flock: mine:Stone: lacks velocities"),
    ("--flock mine:Moody", "mine:Moody: cannot be written, because it does not say what its parameters are"),
    ("--scenario herd.toml --body mine:Cart", "'mine:Crowd' is a class of somebody's own and was not handed over"),
    ("--scenario herd.toml --flock mine:Crowd", "--body module:Name hands over a body and --flock"),
    ("--scenario post.toml", "an obstacle or a layout of one's own, or several bodies, is itself given"),
    ("--scenario mine:Chase", "scenario: mine:Chase: needs a Scenario (given: <class"),
    ("--scenario mine:Nobody", "scenario: mine:Nobody: module 'mine' has no 'Nobody'"),
    ("--body mine:Stuck", "mine:Stuck.follow: is called with (pose, wanted, dt); this one takes (pose, wanted)"),
    ("--body mine:Dizzy", "Dizzy.follow: velocity and spin must be finite"),
    ("--flock mine:Lost", "flock model (mine:Lost): velocities need shape (6, 2) (given: (2,))"),
    ("--scenario broken.toml --body mine:Cart", "Scenario.shepherds[0]: mine:Cart: a cart has a size"),
    ("--scenario full.toml", "obstacles"),
    ("--grid nowhere.toml", "nowhere.toml: cannot be read"),
    ("--grid bad.toml", "bad.toml: is not a TOML file"),
    ("--grid odd.toml", "odd.toml: n_shep is unknown; a grid sets controllers, flocks"),
    ("--grid words.toml", "words.toml: flocks must be a list of whole numbers (given: ['two'])"),
    ("--grid true.toml", "true.toml: trials must be a whole number (given: True)"),
    ("--grid none.toml", "none.toml: flocks must be a list of whole numbers (given: [])"),
    ("--grid zero.toml", "flocks: 0 is impossible"),
    ("--grid flocks.toml --flocks 1", "--flocks is given and flocks.toml sets flocks too: leave one of them out"),
    ("--out tiny.toml", "tiny.toml: cannot be made or written (it is a file, not a folder)"),
    ("--out tiny.toml/deeper", "cannot be made or written"),
    ("--out other", "other/ledger.sqlite: holds rows of shepherd_phys 0.0.0, this is"),
    ("--out used", "used: is in use by another run; wait for it or choose another folder"),
    ("--flcks 1", "Unrecognized options: --flcks, 1; did you mean --flocks? (see"),
    ("--save_replai x", "; did you mean --save-replay? (see"),
    ("--obstacles 12", "Unrecognized options: --obstacles, 12 (see shepherd-phys evaluate --help)"),
    ("--controllers strombon", "; did you mean strombom?"),
    ("--body Flier", "; did you mean Flyer?"),
    ("idle", "Unrecognized options: idle"),
]


@pytest.mark.parametrize(("words", "message"), MISTAKES, ids=[words for words, _ in MISTAKES])
def test_mistakes_are_one_clear_line(folder, capsys, words, message):
    Path("bad.toml").write_text("n_sheep = = 3")
    Path("odd.toml").write_text("n_shep = 3")
    Path("many.toml").write_text("".join(f"{name} = 1\n" for name in "abcde"))
    Path("preset.toml").write_text(tomli_w.dumps({"reward": "wild", "ppo": {"n_steps": 50}, "scenario": TINY}))
    Path("herd.toml").write_text(tomli_w.dumps(HERD))
    Path("post.toml").write_text(tomli_w.dumps({**TINY, "obstacles": [{"kind": "mine:Post"}]}))
    Path("broken.toml").write_text(tomli_w.dumps({**TINY, "shepherds": [{"kind": "mine:Cart", "size": -1.0}]}))
    Path("full.toml").write_text(tomli_w.dumps({**TINY, "obstacles": [BOULDER]}))
    Path("heavy.toml").write_text(tomli_w.dumps({**TINY, "shepherds": [{"kind": "mine:Heavy", "mass": 3.0}]}))
    Path("leaves.py").write_text("raise SystemExit(3)")
    Path("base.toml").write_text('baseline = "nobody"')
    Path("words.toml").write_text('flocks = ["two"]')
    Path("true.toml").write_text("trials = true")
    Path("none.toml").write_text("flocks = []")
    Path("zero.toml").write_text("flocks = [1, 0]")
    Path("flocks.toml").write_text("flocks = [1, 2]")
    Ledger("other", "0.0.0").close()
    before = sorted(Path().iterdir())
    given_words = words.split()
    if "--scenario" not in given_words:
        given_words = ["--scenario", "tiny.toml", *given_words]
    with Ledger("used", __version__):
        assert main.main(["evaluate", *given_words]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    told = mistakes(said.err)
    assert len(told) == 1
    assert told[0].startswith("shepherd-phys evaluate: ")
    assert message in told[0]
    assert not Path("results").exists()
    assert sorted(path for path in Path().iterdir() if path.name not in ("__pycache__", "used")) == before


def test_a_mistake_in_a_shell(folder):
    done = shell("evaluate --controllers nobody")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.count("\n") == 1
    assert "Traceback" not in done.stderr


def test_a_full_disk(folder, in_process, capsys, monkeypatch):
    def full(fd):
        raise OSError(28, "No space left on device")

    assert run("--controllers", "idle") == 0
    capsys.readouterr()
    monkeypatch.setattr("os.fsync", full)
    assert run("--controllers", "idle") == 1
    said = capsys.readouterr()
    assert said.out == ""
    assert "shepherd-phys evaluate: results/episodes.csv: cannot be written (No space left on device)" in said.err
    assert len(read("results/episodes.csv")) == 2


@pytest.mark.parametrize("encoding", ["utf-8", "ascii"])
def test_mistakes_are_one_line_on_any_terminal(monkeypatch, encoding):
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(io.BytesIO(), encoding=encoding))
    with pytest.raises(SettingsError) as problem:
        read_options(["--flocks", "abc"])
    assert str(problem.value) == (
        "Error parsing --flocks: Could not find valid parse for arguments: ['abc']; "
        "--flocks takes whole numbers (see shepherd-phys evaluate --help)"
    )


@given(st.text(alphabet="0123456789/-+ ²", max_size=6))
def test_a_shard_is_read_or_refused(text):
    try:
        number, count = read_shard(text)
    except SettingsError:
        return
    assert 1 <= number <= count


# ---- the front door -----------------------------------------------------------------------------------------------


def test_help_lists_every_flag(capsys):
    with pytest.raises(SystemExit) as end:
        main.main(["evaluate", "--help"])
    assert end.value.code == 0
    said = capsys.readouterr().out
    for flag in (*GRID_KEYS, "grid", "shard", "workers", "scheduler", "timeout", "out", "gather", "json"):
        assert f"--{flag}" in said


def test_front_door(capsys):
    assert main.main(["--help"]) == 0
    assert "evaluate" in capsys.readouterr().out
    assert main.main(["--version"]) == 0
    assert capsys.readouterr().out == f"shepherd-phys {__version__}\n"
    assert main.main(["evalute"]) == 2
    assert "; did you mean evaluate? (see --help)" in capsys.readouterr().err
    for argv, problem in (([], "no command"), (["dance"], "unknown command 'dance'")):
        assert main.main(argv) == 2
        said = capsys.readouterr()
        assert said.out == ""
        assert said.err.startswith(f"shepherd-phys: {problem}; commands are {', '.join(main.COMMANDS)}")


def test_commands_exist():
    scripts = Path(main.__file__).parent
    assert [name for name in main.COMMANDS if not (scripts / f"{name}.py").exists()] == []


def test_a_closed_pipe_is_no_error():
    words = f"'{COMMAND}' --help | true"
    done = subprocess.run(["sh", "-c", words], capture_output=True, text=True, timeout=300)
    assert "Traceback" not in done.stderr
