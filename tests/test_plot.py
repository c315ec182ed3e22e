"""``shepherd-phys plot``: what the figures are made of, their files, and every mistake."""

import csv
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from shepherd_phys.controllers.evaluation import COLUMNS
from shepherd_phys.learning.folder import CURVE_COLUMNS, VALIDATION_COLUMNS

pytest.importorskip("matplotlib")

from shepherd_phys.obstacles import Box, Pillar, Wall
from shepherd_phys.scenario import SCENARIOS
from shepherd_phys.scripts import learning_figures, main, plot
from shepherd_phys.scripts.path_figures import corners
from shepherd_phys.scripts.paths import CELL, CELLS, REACH, Mapped, maps, stood, turned, walks
from shepherd_phys.scripts.points import Point
from shepherd_phys.settings import SettingsError

TINY = SCENARIOS["small"].but(n_sheep=6, n_steps=8)
STARTS = {"png": b"\x89PNG", "svg": b"<?xml", "pdf": b"%PDF"}


def episodes(path, changes=({},), trials=3):
    """A table of episodes: for each of ``changes`` of the labels so many trials."""
    path.parent.mkdir(exist_ok=True)
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        for change in changes:
            for seed in range(trials):
                row = dict.fromkeys(COLUMNS, "1") | {"controller": "idle", "scenario": "paper", "n_sheep": "100"}
                row |= {"cohesion": "40", "reached_95": "true", "success": "false", "path_length": f"{seed}.5"}
                writer.writerow(row | {"in_goal_end": "50.0", "seed": seed} | change)
    return path


def run_folder(path, seed=0, rollouts=10, level=1.0, preset='reward = "wild"\n', validated=True):
    """A folder as ``train`` leaves it, with the reward at ``level``."""
    path.mkdir()
    (path / "preset.toml").write_text(f"{preset}seed = {seed}\nbudget = {rollouts * 100}\n", encoding="utf-8")
    with open(path / "curve.csv", "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, CURVE_COLUMNS)
        writer.writeheader()
        for k in range(1, rollouts + 1):
            row = dict.fromkeys(CURVE_COLUMNS, "1.0") | {"rollout": k, "shepherd_steps": 100 * k}
            writer.writerow(row | {"episode_reward": level if k > 2 else ""})
    if validated:
        with open(path / "validation.csv", "w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, VALIDATION_COLUMNS)
            writer.writeheader()
            for n_flocks, home in ((1, 100.0), (2, 50.0)):
                row = dict.fromkeys(VALIDATION_COLUMNS, "1") | {"checkpoint": 1, "shepherd_steps": 1000}
                writer.writerow(row | {"n_flocks": n_flocks, "in_goal_end": home})
    return path


def mistake(capsys, *words):
    """The one line with which a command is refused."""
    capsys.readouterr()
    assert main.main(["plot", *map(str, words)]) == 2
    said = capsys.readouterr()
    assert not said.out
    assert said.err.count("\n") == 1
    return said.err


@pytest.fixture
def drawn(monkeypatch):
    """What the measures' figure is handed, which is not drawn."""
    from shepherd_phys.scripts import figures

    handed = []
    monkeypatch.setattr(figures, "draw_measures", lambda *values: handed.append(values) or b"drawn")
    return handed


@pytest.mark.parametrize("kind", STARTS)
def test_measures_in_every_kind_of_file(tmp_path, kind, capsys):
    table = episodes(tmp_path / "episodes.csv", [{"n_flocks": k} for k in (1, 2)])
    out = tmp_path / f"figure.{kind}"
    words = ["plot", "measures", str(table), "--out", str(out)]
    assert main.main(words) == 0
    assert capsys.readouterr().out == f"{out}\n"
    first = out.read_bytes()
    assert first.startswith(STARTS[kind])
    assert main.main([*words, "--measure", "in_goal_end", "path_length"]) == 0
    assert out.read_bytes() == first  # the same rows give the same bytes
    assert sorted(path.name for path in tmp_path.iterdir()) == ["episodes.csv", out.name]


def test_measures_are_means_with_intervals(tmp_path, drawn):
    changes = [{"n_flocks": k, "controller": name} for k in (1, 2) for name in ("strombom", "mine:A", "collie")]
    table = episodes(tmp_path / "episodes.csv", changes)
    out = ["--out", str(tmp_path / "figure.png")]
    assert main.main(["plot", "measures", str(table), "--measure", "path_length", "success", *out]) == 0
    summary, label, _, metrics, about, kind = drawn.pop()
    assert (label, kind, list(metrics)) == ("n_flocks", "png", ["path_length", "success"])
    # known ones in the order of all our figures, one's own behind them
    assert [(row["controller"], row["n_flocks"]) for row in summary[::2]] == [
        ("strombom", 1), ("collie", 1), ("mine:A", 1)
    ]  # fmt: skip
    assert all(row["path_length_mean"] == 1.5 and row["success_mean"] == 0.0 for row in summary)
    assert all(row["path_length_low"] == 0.5 and row["path_length_high"] == 2.5 for row in summary)
    assert about == "paper: 100 sheep, 1 shepherd, n = 40; 3 trials a point; mean with 95 % bootstrap interval"
    assert main.main(["plot", "measures", str(table), "--controllers", "mine:A", "strombom", *out]) == 0
    assert list(dict.fromkeys(row["controller"] for row in drawn.pop()[0])) == ["mine:A", "strombom"]


def test_tables_are_put_together_and_no_episode_counts_twice(tmp_path, drawn, capsys):
    first = episodes(tmp_path / "first" / "episodes.csv", [{"n_flocks": 1}, {"n_flocks": 2}])
    second = episodes(tmp_path / "second" / "episodes.csv", [{"n_flocks": 2}, {"n_flocks": 3}])
    out = tmp_path / "figure.png"
    assert main.main(["plot", "measures", str(first.parent), str(second), "--out", str(out)]) == 0
    assert [(row["n_flocks"], row["trials"]) for row in drawn.pop()[0]] == [(1, 3), (2, 3), (3, 3)]
    episodes(second, [{"n_flocks": 2, "in_goal_end": "51.0"}])
    assert "differ about idle, seed 0" in mistake(capsys, "measures", first, second, "--out", out)


def test_nothing_is_mixed(tmp_path, drawn, capsys):
    table = episodes(tmp_path / "episodes.csv", [{}, {"n_flocks": 2}, {"cohesion": 10}, {"cohesion": ""}])
    out = tmp_path / "figure.png"
    said = mistake(capsys, "measures", table, "--out", out)
    assert "cohesion varies, too (None, 10, 40): choose one with --cohesion, or say which to draw --against" in said
    said = mistake(capsys, "measures", table, "--flocks", 1, "--out", out)
    assert "rows without cohesion" in said
    said = mistake(capsys, "measures", table, "--against", "cohesion", "--out", out)
    assert "flocks varies, too (1, 2): choose one with --flocks" in said
    assert not drawn
    assert main.main(["plot", "measures", str(table), "--cohesion", "40", "--out", str(out)]) == 0
    assert [row["n_flocks"] for row in drawn[0][0]] == [1, 2]
    episodes(table, [{}, {"scenario": "fence"}])
    assert "scenario varies (fence, paper)" in mistake(capsys, "measures", table, "--out", out)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ((), "say what to draw; there are measures, trajectories, heatmap, learning"),
        (("curves",), "'curves' is unknown; there are measures"),
        (("measures",), "needs episodes.csv"),
        (("measures", "none.csv"), "none.csv: cannot be read (No such file"),
        (("measures", "broken.csv"), "broken.csv: is no table of episodes (KeyError"),
        (("measures", "empty.csv"), "empty.csv: holds no episode"),
        (("measures", "episodes.csv", "--measure", "speed"), "measure: 'speed' is unknown; there are in_goal_end"),
        (("measures", "episodes.csv", "--against", "n"), "against: 'n' is unknown; there are flocks"),
        (("measures", "episodes.csv", "--flocks", "7"), "flocks: no row has 7; there are 1"),
        (("measures", "episodes.csv", "--controllers", "me"), "controllers: no row has 'me'; there are idle"),
        (("measures", "episodes.csv", "--out", "a.gif"), "out: a.gif must end in .png, .svg, .pdf"),
        (("measures", "episodes.csv", "--out", "no/a.png"), "out: there is no folder no"),
        (("trajectories", "--controller", "nobody"), "'nobody' is unknown"),
        (("trajectories", "--flocks", "0"), "flocks: 0 is impossible; it must be at least 1"),
        (("trajectories", "--color", "red"), "color"),
        (("trajectories", "--scenario", "moon"), "moon"),
        (("heatmap", "--trials", "0"), "trials: 0 is impossible"),
        (("heatmap", "--workers", "0"), "workers: 0 is impossible"),
        (("learning",), "needs folders of training runs"),
        (("learning", "."), ".: holds no training run (no preset.toml)"),
        (("learning", "run", "--smooth", "0"), "smooth: 0 is impossible"),
        (("learning", "run", "--training", "luck"), "training: 'luck' is unknown; there are episode_reward"),
        (("learning", "run", "--validation", "success"), "validation: none of the runs has been validated"),
    ],
)
def test_mistakes_are_told_in_one_line(words, told, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    episodes(tmp_path / "episodes.csv")
    (tmp_path / "broken.csv").write_text("a,b\n1,2\n", encoding="utf-8")
    (tmp_path / "empty.csv").write_text(",".join(COLUMNS) + "\n", encoding="utf-8")
    run_folder(tmp_path / "run", validated=False)
    before = sorted(tmp_path.iterdir())
    assert told in mistake(capsys, *words)
    assert sorted(tmp_path.iterdir()) == before  # no file, not even a part of one


def test_an_earlier_figure_stays_when_drawing_fails(tmp_path, capsys):
    out = tmp_path / "figure.png"
    out.write_bytes(b"earlier")
    mistake(capsys, "measures", tmp_path / "none.csv", "--out", out)
    assert out.read_bytes() == b"earlier"


def test_every_kind_has_help(capsys):
    assert main.main(["plot", "--help"]) == 0
    listing = capsys.readouterr().out
    for kind in plot.PLOTS:
        assert f"  {kind} " in listing
        with pytest.raises(SystemExit) as end:
            main.main(["plot", kind, "--help"])
        assert not end.value.code
        assert "--out" in capsys.readouterr().out


def test_walks_are_the_episodes():
    point = Point("strombom", "tiny", TINY)
    walk = walks(point, 5)
    assert walk.sheep.shape == (9, 6, 2)
    assert walk.shepherds.shape == (9, 2, 2)
    np.testing.assert_array_equal(walk.sheep[0], walk.start.sheep_pos)
    steps = np.linalg.norm(np.diff(walk.shepherds, axis=0), axis=2)
    assert steps.sum(axis=0).mean() == pytest.approx(walk.row["path_length"])
    again = walks(point, 5)
    np.testing.assert_array_equal(again.sheep, walk.sheep)


def test_the_flocks_frame_has_the_sheep_straight_up():
    walk = walks(Point("idle", "tiny", TINY), 3)
    seen = turned(walk.sheep[0], walk.start, "flock")
    x, y = seen.mean(axis=0)
    assert x == pytest.approx(0.0, abs=1e-9)
    assert y > 5.0
    plain = turned(walk.sheep[0], walk.start, "world")
    np.testing.assert_allclose(plain, walk.sheep[0] - walk.start.goal_pos)
    np.testing.assert_allclose(np.linalg.norm(seen, axis=1), np.linalg.norm(plain, axis=1))
    # turned, not mirrored
    assert np.linalg.det(seen[[0, -1]]) == pytest.approx(np.linalg.det(plain[[0, -1]]))


def test_a_map_counts_every_second():
    point = Point("idle", "tiny", TINY)
    row = stood(Mapped(point, "sheep", "world"), 3)
    walk = walks(point, 3)
    assert sum(row["counts"]) == 8 * 6  # all of these sheep are near enough
    x, y = walk.sheep[-1, 0] - walk.start.goal_pos
    cell = int((x + REACH) // CELL) + CELLS * int((y + REACH) // CELL)
    assert cell in row["cells"]
    (one,) = maps([point], [3, 4], "sheep", "world", workers=0)
    assert one.seconds.shape == (CELLS, CELLS)
    assert one.seconds[int((y + REACH) // CELL), int((x + REACH) // CELL)] > 0.0
    # a sheep is somewhere for the 1.6 s of an episode
    assert one.seconds.sum() * CELL**2 == pytest.approx(8 * 0.2)
    assert one.trials == 2


def test_outlines_hold_the_obstacles():
    pillar, wall, box = corners([Pillar((1.0, 2.0), 0.5), Wall((0, 0), (4, 0), 0.2), Box((5.0, 5.0), (2.0, 1.0))])
    np.testing.assert_allclose(np.linalg.norm(pillar - (1.0, 2.0), axis=1), 0.5)
    np.testing.assert_allclose([wall.min(axis=0), wall.max(axis=0)], [[-0.1, -0.1], [4.1, 0.1]], atol=1e-9)
    np.testing.assert_allclose([box.min(axis=0), box.max(axis=0)], [[4.0, 4.5], [6.0, 5.5]], atol=1e-9)


@pytest.mark.parametrize("color", ["time", "flock"])
def test_trajectories_are_drawn(tmp_path, color):
    scenario = TINY.but(obstacles=(Pillar((0.0, 30.0), 1.0),))
    scenario.to_toml(tmp_path / "tiny.toml")
    out = tmp_path / "paths.png"
    words = ["--scenario", str(tmp_path / "tiny.toml"), "--controller", "strombom", "--color", color, "--seed", "4"]
    assert main.main(["plot", "trajectories", *words, "--out", str(out)]) == 0
    assert out.read_bytes().startswith(STARTS["png"])


def test_heat_maps_do_not_depend_on_workers(tmp_path):
    TINY.to_toml(tmp_path / "tiny.toml")
    words = ["--scenario", str(tmp_path / "tiny.toml"), "--controllers", "idle", "random", "--trials", "2"]
    files = []
    for n in (1, 2):
        out = tmp_path / f"{n}.png"
        assert main.main(["plot", "heatmap", *words, "--workers", str(n), "--out", str(out)]) == 0
        files.append(out.read_bytes())
    assert files[0] == files[1]
    assert files[0].startswith(STARTS["png"])


@pytest.mark.parametrize(
    "words",
    [
        ("heatmap", "--controllers", "mine:Faint", "--trials", "1", "--workers", "1", "--out", "figure.png"),
        ("trajectories", "--controller", "mine:Faint", "--out", "figure.png"),
    ],
    ids=lambda words: words[0],
)
def test_a_controller_that_fails_leaves_no_figure(tmp_path, words):
    """From the folder of a user's own file."""
    (tmp_path / "mine.py").write_text(
        "class Faint:\n    lidar = None\n    def reset(self, rng): raise RuntimeError('not today')\n"
        "    def act(self, observation, state): ...\n",
        encoding="utf-8",
    )
    TINY.to_toml(tmp_path / "tiny.toml")
    command = str(Path(sys.executable).with_name("shepherd-phys"))
    done = subprocess.run(
        [command, "plot", *words, "--scenario", "tiny.toml"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 1
    assert "not today" in done.stderr.splitlines()[-1]
    assert not (tmp_path / "figure.png").exists()


def test_seeds_of_one_recipe_are_averaged(tmp_path, monkeypatch):
    runs = [
        run_folder(tmp_path / "wild-0", 0, 10, 1.0),
        run_folder(tmp_path / "wild-1", 1, 8, 3.0),
        run_folder(tmp_path / "other", 0, 10, 7.0, preset='reward = "any"\n'),
    ]
    handed = []
    monkeypatch.setattr(
        learning_figures, "line", lambda axes, steps, values, color, style, label: handed.append((label, steps, values))
    )
    out = tmp_path / "learning.png"
    assert main.main(["plot", "learning", *map(str, runs), "--out", str(out)]) == 0
    (wild, steps, values), (other, _, alone), (_, at, homes), _ = handed
    assert (wild, other) == ("wild (2 seeds)", "other")
    np.testing.assert_array_equal(steps, np.arange(300.0, 801.0, 100.0))  # as far as both have come
    np.testing.assert_array_equal(values, [[1.0] * 6, [3.0] * 6])
    np.testing.assert_array_equal(alone, [[7.0] * 8])
    np.testing.assert_array_equal(at, [1000.0])
    np.testing.assert_array_equal(homes, [[75.0], [75.0]])  # mean over the points of a validation
    handed.clear()
    assert main.main(["plot", "learning", str(runs[0]), "--smooth", "4", "--out", str(out)]) == 0
    assert len(handed[0][1]) == 2  # the last two rollouts are no whole four
    assert out.read_bytes().startswith(STARTS["png"])


def test_runs_without_a_whole_episode_yet_say_so(tmp_path):
    run = run_folder(tmp_path / "young", rollouts=2, validated=False)
    out = tmp_path / "learning.svg"
    assert main.main(["plot", "learning", str(run), "--out", str(out)]) == 0
    assert "nothing yet" in out.read_text(encoding="utf-8")


def test_recipes_with_folders_of_the_same_name_are_told_apart(tmp_path):
    for name, reward in (("a", "wild"), ("b", "any")):
        (tmp_path / name).mkdir()
        run_folder(tmp_path / name / "run", preset=f'reward = "{reward}"\n')
    found = plot.recipes([tmp_path / "a" / "run", tmp_path / "b" / "run", tmp_path / "a" / "run"])
    assert [name for name, _ in found] == [str(tmp_path / "a" / "run"), str(tmp_path / "b" / "run")]
    with pytest.raises(SettingsError, match="holds no training run"):
        plot.recipes([tmp_path])
