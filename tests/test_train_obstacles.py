"""``train --scenario``, ``--obstacles`` and ``--density``: what they make of a preset, and their mistakes."""

from pathlib import Path

import numpy as np
import pytest

from shepherd_phys.bodies import DifferentialDrive
from shepherd_phys.flock import Reynolds
from shepherd_phys.layouts import Fenced, Lattice, Scattered
from shepherd_phys.learning.folder import PRESET
from shepherd_phys.learning.preset import PRESETS, Preset, load_preset
from shepherd_phys.scripts.command import parsed
from shepherd_phys.scripts.train import Train, asked, main, prepare


def prepared(words):
    return prepare(*parsed(Train, "train", words.split()), {})


@pytest.mark.parametrize(
    ("words", "layout", "folder"),
    [
        ("--obstacles 12", Scattered(count=12), "runs/fast-wild-1000000-obstacles12"),
        ("--density 0.01", Scattered(density=0.01), "runs/fast-wild-1000000-density0.01"),
        ("--scenario fence", Fenced(), "runs/fast-wild-1000000-fence"),
        (
            "--scenario scattered --density 0.02",
            Scattered(density=0.02),
            "runs/fast-wild-1000000-scattered-density0.02",
        ),
    ],
)
def test_a_run_gets_its_obstacles_and_a_folder_of_its_own(words, layout, folder, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    made, preset = prepared(words)
    assert made == Path(folder)
    assert preset.scenario.layout == layout
    assert Preset.from_toml(made / PRESET) == preset
    assert prepared(f"--resume --out {made}")[1] == preset


def test_a_scenario_says_where_its_flocks_are():
    preset = asked(load_preset("collie"), *parsed(Train, "train", ["--scenario", "fence"]), {})
    assert preset.flock_distance is None
    assert preset.draw().base.flock_distance == (14.0, 20.0)


def test_a_scenario_that_is_asked_for_is_the_only_one():
    preset = asked(load_preset("collie-obstacles"), *parsed(Train, "train", ["--scenario", "lattice"]), {})
    draw, rng = preset.draw(), np.random.default_rng(0)
    assert {type(draw(rng, 0).layout) for _ in range(30)} == {Lattice}


def test_a_body_that_is_asked_for_is_that_of_every_episode():
    kinds = {"body": DifferentialDrive, "flock": Reynolds}
    preset = asked(load_preset("collie-obstacles"), *parsed(Train, "train", []), kinds)
    draw, rng = preset.draw(), np.random.default_rng(0)
    drawn = [draw(rng, 0) for _ in range(30)]
    assert len({type(scenario.layout) for scenario in drawn}) > 2
    assert {type(body) for scenario in drawn for body in scenario.shepherds} == {DifferentialDrive}
    assert {scenario.flock for scenario in drawn} == {Reynolds()}  # which has no n to draw


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('[scenario]\nshepherds = [{kind = "mine:Tank"}]\n', "mine:Tank"),  # not handed over
        ('scenarios = ["scattered"]\ndensity = [0.0, 0.45]\n', "density: 0.45 is impossible"),  # no room for the most
        # room where it learns, and none where it is validated
        ('density = [0.0, 0.01]\n[scenario.layout]\nkind = "Scattered"\ndensity = 0.45\n', "0.45 is impossible"),
    ],
)
def test_a_preset_that_cannot_be_leaves_no_folder(text, message, tmp_path, capsys):
    preset = tmp_path / "mine.toml"
    preset.write_text(text)
    assert main(["--preset", str(preset), "--out", str(tmp_path / "run")]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_a_density_that_is_asked_for_is_drawn_instead_of_the_presets():
    preset = asked(load_preset("collie-obstacles"), *parsed(Train, "train", ["--density", "0.03"]), {})
    draw, rng = preset.draw(), np.random.default_rng(0)
    layouts = [draw(rng, 0).layout for _ in range(30)]
    assert {layout.density for layout in layouts if isinstance(layout, Scattered)} == {0.03}
    assert preset.scenario.layout == Scattered(density=0.03)  # in which it is validated


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--obstacles 3 --density 0.1", "--obstacles and --density: both say how many obstacles there are"),
        (
            "--scenario fence --obstacles 3",
            "--obstacles: scatters discs, and the scenario has a layout of its own, Fenced; give one or the other",
        ),
        ("--preset collie-obstacles --obstacles 3", "--obstacles: the preset draws another density for each episode"),
        ("--obstacles -1", "obstacles: -1 is impossible; it must be at least 0"),
        ("--obstacles many", "--obstacles takes a whole number"),
        ("--density 0.9", "Scattered.density: Input should be less than or equal to 0.5 (given: 0.9)"),
        ("--density 0.48", "Scattered.density: 0.48 is impossible:"),
        ("--density nan", "Scattered.density"),
        ("--scenario desert", "scenario: 'desert' is neither a .toml file nor one of paper"),
    ],
)
def test_mistakes_are_one_line_before_anything_is_made(words, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(words.split()) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert message in said
    assert list(tmp_path.iterdir()) == []


def test_help_names_every_preset(capsys):
    with pytest.raises(SystemExit):
        main(["--help"])
    said = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert f"How to train: {', '.join(PRESETS)}, or a TOML file of your own." in said
