"""``shepherd-phys evaluate --save-replay``: every episode of a campaign leaves its file."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
import tomli_w

from shepherd_phys.controllers.evaluation import trial_seed
from shepherd_phys.replay_file import load_replay
from shepherd_phys.scripts import evaluate
from shepherd_phys.scripts.points import points
from shepherd_phys.scripts.replays import file_name

COMMAND = Path(sys.executable).with_name("shepherd-phys")
TINY = {"n_sheep": 6, "n_flocks": 2, "shepherds": 2, "n_steps": 6}
GRID = ["--controllers", "strombom", "idle", "--scenario", "tiny.toml"]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    (tmp_path / "tiny.toml").write_text(tomli_w.dumps(TINY))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def shell(*words, status=0):
    done = subprocess.run(
        [COMMAND, "evaluate", *GRID, *words], capture_output=True, text=True, timeout=600, check=False
    )
    assert done.returncode == status, done.stderr
    assert "Traceback" not in done.stderr
    return done


def expected(trials):
    seeds = [trial_seed(20_000, trial) for trial in range(trials)]
    return {
        file_name(point, point.settings_hash(), trial, seed): (point.controller, seed)
        for point in points(controllers=("strombom", "idle"), scenario="tiny.toml")
        for trial, seed in enumerate(seeds)
    }


def found(folder):
    return {path.name: path.read_bytes() for path in Path(folder).iterdir()}


def test_each_episode_leaves_a_file_that_a_resumed_campaign_completes(folder):
    shell("--trials", "1", "--workers", "2", "--out", "a")  # no replays yet
    before = Path("a/episodes.csv").read_text()
    done = shell("--trials", "2", "--workers", "2", "--out", "a", "--save-replay", "deep/replays")
    assert "4 replays in deep/replays" in done.stdout.splitlines()
    assert set(found("deep/replays")) == set(expected(2))
    assert set(before.splitlines()) <= set(Path("a/episodes.csv").read_text().splitlines())
    for name, (controller, seed) in expected(2).items():
        replay = load_replay(Path("deep/replays", name))
        assert (replay.controller, replay.scenario_name, replay.seed) == (controller, "tiny.toml", seed)
        assert list(replay.rewards) == ["occupy", "distance", "occlude"]
        replay.verify()

    Path("deep/replays", sorted(expected(2))[0]).unlink()
    again = shell("--trials", "2", "--workers", "1", "--out", "a", "--save-replay", "deep/replays", "--json")
    assert len(json.loads(again.stdout)) == 2
    assert "4 replays in deep/replays" in again.stderr
    fresh = shell("--trials", "2", "--workers", "1", "--out", "b", "--save-replay", "other")
    assert "4 replays in other" in fresh.stdout
    assert found("other") == found("deep/replays")
    assert Path("a/episodes.csv").read_bytes() == Path("b/episodes.csv").read_bytes()


def test_a_folder_that_cannot_be_is_told_before_anything_runs(folder, capsys):
    (folder / "file").write_text("")
    assert evaluate.main([*GRID, "--trials", "1", "--workers", "1", "--out", "out", "--save-replay", "file"]) == 2
    said = capsys.readouterr().err
    assert len(said.splitlines()) == 1 and "save-replay: file: cannot be made" in said
    assert not Path("out").exists()


def test_names_are_fit_for_files_and_different(folder):
    one = points(controllers=("idle",), scenario="tiny.toml")[0]
    strange = type(one)("my.module:Own Chaser/../x", "weird/na me.toml", one.scenario)
    policy = type(one)("deep/er/policy.json", "tiny.toml", one.scenario)
    names = [file_name(point, "ab" * 32, 0, 5) for point in (one, strange, policy)]
    names.append(file_name(one, "cd" * 32, 0, 5))
    names += [file_name(one, "ab" * 32, *of) for of in ((0, 6), (1, 5))]
    assert len(set(names)) == len(names)
    assert all(set(name) <= set("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789._-") for name in names)
    assert names[0] == "idle_tiny_2-flocks_n40_2-shepherds_6-sheep_abababab_trial-0_seed-5.npz"
    assert names[2].startswith("policy_tiny_")
    assert len(file_name(type(one)("x" * 500, "y" * 500, one.scenario), "ab" * 32, 10**9, 2**63 - 1)) < 250
