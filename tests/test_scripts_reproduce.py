"""``shepherd-phys reproduce`` from the outside: files, JSON, continuing, one ledger for both figures, and mistakes."""

import csv
import json
import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest
import tomli_w

from shepherd_phys import __version__, campaign
from shepherd_phys.campaign import Ledger
from shepherd_phys.controllers import CONTROLLERS
from shepherd_phys.controllers.claims import EVERYWHERE, EXPERIMENTS, HEURISTICS, LITERAL
from shepherd_phys.controllers.evaluation import COLUMNS, trial_seed
from shepherd_phys.controllers.summary import summary_columns
from shepherd_phys.layouts import Scattered
from shepherd_phys.scenario import load_scenario
from shepherd_phys.scripts import beyond, main, reproduce
from shepherd_phys.scripts.pages import claims_page, figure_page, study_page
from shepherd_phys.scripts.points import place, points, tasks
from shepherd_phys.scripts.reproduce import CHOICES, read_options, roster, work

pytest.importorskip("matplotlib")

TINY = {"n_sheep": 6, "n_flocks": 2, "shepherds": 2, "n_steps": 6}
COMMAND = Path(sys.executable).with_name("shepherd-phys")
FIGURE_2 = ["figure2.csv", "figure2.md", "figure2.png"]
FIGURE_3 = ["figure3.csv", "figure3.md", "figure3.png"]
CLAIMS = ["claims.json", "claims.md"]
MINE = """
import numpy as np
class Bad:
    lidar = None
    def reset(self, rng): pass
    def act(self, observation, state):
        print("a controller that prints")
        return np.full((state.n_shepherds, 2), np.nan if state.sheep_pos[0, 0] > 0 else 0.0)
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A working directory in which the paper's world is a tiny one, and nothing is sent to worker processes."""
    (tmp_path / "tiny.toml").write_text(tomli_w.dumps(TINY))
    (tmp_path / "mine.py").write_text(MINE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(reproduce, "SCENARIO", "tiny.toml")
    monkeypatch.setattr(campaign, "run", partial(campaign.run, retries=0))
    monkeypatch.setitem(reproduce.LEAST, "workers", 0)
    yield tmp_path
    sys.modules.pop("mine", None)


def run(*words, workers=0):
    return main.main(["reproduce", "--trials", "2", "--workers", str(workers), "--out", "o", *words])


def read(path):
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def contents():
    return {path.name: path.read_bytes() for path in Path("o").iterdir() if not path.name.startswith("ledger")}


def said_wrong(err):
    return [line for line in err.splitlines() if line.startswith("shepherd-phys")]


# ---- what it writes -------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_papers_world_in_a_shell(tmp_path):
    done = subprocess.run(
        [COMMAND, *["reproduce", "figure2", "--controllers", "idle", "--trials", "1", "--workers", "1", "--json"]],
        capture_output=True,
        text=True,
        timeout=300,
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    assert list(said) == ["figure2", "claims"]
    out = tmp_path / "results" / "reproduce"
    assert [(row["n_flocks"], row["cohesion"]) for row in said["figure2"]] == [(k, 40) for k in range(1, 6)]
    for row in said["figure2"]:
        assert (row["controller"], row["n_shepherds"], row["n_sheep"], row["scenario"]) == ("idle", 3, 100, "paper")
        assert (row["trials"], row["path_length_mean"], row["steps_mean"]) == (1, 0.0, 1000.0)
    assert said["claims"] == json.loads((out / "claims.json").read_text("utf-8"))
    assert {row["seed"] for row in read(out / "episodes.csv")} == {str(trial_seed(20_000, 0))}
    assert "results/reproduce/figure2.png" in done.stderr


def test_all_writes_both_figures_and_the_claims(folder, capsys):
    assert run("all", "--controllers", "strombom", "idle") == 0
    out = capsys.readouterr().out
    assert sorted(contents()) == sorted(["episodes.csv", *FIGURE_2, *FIGURE_3, *CLAIMS])
    assert out.splitlines()[-9:] == [f"o/{name}" for name in ["episodes.csv", *FIGURE_2, *FIGURE_3, *CLAIMS]]
    rows = read("o/episodes.csv")
    assert tuple(rows[0]) == COLUMNS
    assert len(rows) == 2 * len(EVERYWHERE) * 2  # two flocks with n = 40 once
    assert {row["seed"] for row in rows} == {str(trial_seed(20_000, i)) for i in (0, 1)}
    for name, experiment in EXPERIMENTS.items():
        table = read(f"o/{name}.csv")
        assert tuple(table[0]) == (*summary_columns(), "settings_hash")
        found = [(row["controller"], (int(row["n_flocks"]), int(row["cohesion"]))) for row in table]
        assert found == [(method, at) for method in ("strombom", "idle") for at in experiment.points]
        assert {row["trials"] for row in table} == {"2"}
        assert f"![{experiment.title}" in Path(f"o/{name}.md").read_text("utf-8")
        assert Path(f"o/{name}.png").read_bytes().startswith(b"\x89PNG")
    report = json.loads(Path("o/claims.json").read_text("utf-8"))
    assert (report["trials"], report["seed"], report["version"]) == (2, 20_000, __version__)
    assert [claim["claim"] for claim in report["claims"]] == [f"c{i}" for i in range(1, 9)]
    assert Path("o/claims.md").read_text("utf-8") == claims_page(report)
    for word in ("in at the end %", "c7", "undecided", "pierson", "verdicts on 2 are a rehearsal"):
        assert word in out


def test_both_figures_share_what_they_share(folder, capsys):
    assert run("figure2", "--controllers", "idle") == 0
    first = contents()
    assert sorted(first) == sorted(["episodes.csv", *FIGURE_2, *CLAIMS])
    with Ledger("o", __version__) as ledger:
        tasks = work(["figure2", "figure3"], ["idle"], [trial_seed(20_000, i) for i in (0, 1)])
        assert len(ledger.rows(task.settings_hash for task in tasks)) == 5 * 2
    computed = []
    real = campaign.run

    def watched(*args, **more):
        outcome = real(*args, **more)
        computed.append(outcome.computed)
        return outcome

    campaign.run = watched  # the fixture puts the original back
    assert run("figure3", "--controllers", "idle") == 0
    assert computed == [5 * 2]
    assert {name: contents()[name] for name in FIGURE_2} == {name: first[name] for name in FIGURE_2}
    assert len(read("o/episodes.csv")) == 10 * 2
    capsys.readouterr()
    assert run("all", "--controllers", "idle", "--json") == 0
    assert computed == [5 * 2, 0]
    said = json.loads(capsys.readouterr().out)
    assert list(said) == ["figure2", "figure3", "claims"]
    assert figure_page("figure3", said["figure3"]) == Path("o/figure3.md").read_text("utf-8")


def test_who_has_the_best_beside_them_is_compared_with_it_trial_by_trial(folder, monkeypatch):
    monkeypatch.setattr(reproduce, "BASELINE", "idle")
    assert run("all", "--controllers", "strombom", "idle", "elfiqi") == 0
    rows = [row for row in read("o/episodes.csv") if (row["n_flocks"], row["cohesion"]) == ("2", "40")]
    path = {(row["controller"], row["seed"]): float(row["path_length"]) for row in rows}
    longer = [path[name, seed] - path["idle", seed] for name, seed in path if name == "elfiqi"]
    for name in ("figure2", "figure3"):
        table = read(f"o/{name}-differences.csv")
        assert [row["controller"] for row in table] == ["strombom"] * (len(table) // 2) + ["elfiqi"] * (len(table) // 2)
        (told,) = [r for r in table if (r["controller"], r["n_flocks"], r["cohesion"]) == ("elfiqi", "2", "40")]
        assert (told["baseline"], told["trials"]) == ("idle", "2")
        assert float(told["path_length_diff_mean"]) == pytest.approx(sum(longer) / 2) and sum(longer) > 0
        assert "**Path of a shepherd, m: each minus `idle`, paired by trial**" in Path(f"o/{name}.md").read_text(
            "utf-8"
        )
    assert run("figure2", "--controllers", "strombom") == 0
    assert not Path("o/figure2-differences.csv").exists()  # an earlier run's comparison must not stand for this one
    assert "each minus" not in Path("o/figure2.md").read_text("utf-8")


def test_a_finished_run_runs_nothing_and_writes_the_same(folder, monkeypatch):
    assert run("all", "--controllers", "idle") == 0
    first = contents()
    monkeypatch.setattr("shepherd_phys.campaign.attempt", None)
    assert run("all", "--controllers", "idle") == 0
    assert contents() == first


def test_claims_wait_for_all_trials_of_the_other_figure(folder):
    def missing():
        report = json.loads(Path("o/claims.json").read_text("utf-8"))
        (c7,) = [claim for claim in report["claims"] if claim["claim"] == "c7"]
        (part,) = [part for part in c7["parts"] if part["method"] == "strombom"]
        return part["note"] if "not run" in part["note"] else ""

    assert run("figure3", "--controllers", "strombom") == 0
    assert missing() == ""
    assert run("figure2", "--controllers", "strombom", "--trials", "3") == 0  # figure 3 has two of the three trials
    assert missing() == "not run: n = 10, n = 25, n = 55, n = 70, n = 85"


DRIVER = """
import sys
from shepherd_phys.scripts import main, reproduce
reproduce.SCENARIO = "tiny.toml"
if __name__ == "__main__":
    sys.exit(main.main(sys.argv[1:]))
"""


@pytest.mark.slow
def test_a_killed_run_continues_and_ends_the_same(folder):
    Path("driver.py").write_text(DRIVER)
    words = ["reproduce", "figure2", "--controllers", "idle", "random", "--trials", "60", "--out", "o", "--workers"]
    command = [sys.executable, "-P", "driver.py", *words]
    with subprocess.Popen(
        [*command, "1"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
    ) as killed:
        log = Path("o/ledger.sqlite-wal")
        for _ in range(12_000):  # where kernels are compiled first, it takes minutes to begin
            if log.exists() and log.stat().st_size > 30_000:
                break
            time.sleep(0.02)
        else:
            raise AssertionError("it has not begun")
        os.killpg(killed.pid, signal.SIGKILL)
    assert killed.returncode == -signal.SIGKILL
    assert contents() == {}
    seeds = [trial_seed(20_000, i) for i in range(60)]
    with Ledger("o", __version__) as ledger:
        tasks = work(["figure2"], ["idle", "random"], seeds)
        before = len(ledger.rows(task.settings_hash for task in tasks))
    assert 0 < before < len(tasks)
    assert main.main([*words, "0"]) == 0
    ended = contents()
    assert len(read("o/episodes.csv")) == 5 * 2 * 60
    words[words.index("o")] = "unbroken"
    assert main.main([*words, "0"]) == 0
    assert {path: Path("unbroken", path).read_bytes() for path in ended} == ended


def test_failed_episodes_are_named_and_their_points_undecided(folder, capsys):
    assert run("figure2", "--controllers", "mine:Bad", "strombom", "--trials", "4") == 1
    said = capsys.readouterr()
    failed = said_wrong(said.err)
    assert failed
    assert all("no result in 1 attempts: mine:Bad, n_flocks " in line for line in failed)
    assert "a controller that prints" not in said.out
    rows = read("o/episodes.csv")
    assert len(rows) == 5 * 2 * 4 - len(failed)
    assert {row["trials"] for row in read("o/figure2.csv") if row["controller"] == "strombom"} == {"4"}


# ---- who is compared ------------------------------------------------------------------------------------------------


def test_the_roster():
    shipped = [name for name in ("original", "any", "wild", "collie") if name in CONTROLLERS]
    assert roster((), False) == [*HEURISTICS, *shipped]
    assert roster((), True) == [*HEURISTICS, *shipped, *LITERAL]
    assert roster(("idle", "mine:X", "idle"), False) == ["idle", "mine:X"]
    assert roster(("idle",), True) == ["idle", *LITERAL]


def test_a_policy_joins_when_it_exists(monkeypatch):
    monkeypatch.setitem(CONTROLLERS, "wild", CONTROLLERS["idle"])
    assert "wild" in roster((), False)


def test_work_is_three_shepherds_and_a_hundred_sheep():
    tasks = work(["figure2", "figure3"], ["strombom"], [1, 2])
    assert len(tasks) == 10 * 2
    assert {(task.spec.scenario.n_shepherds, task.spec.scenario.n_sheep) for task in tasks} == {(3, 100)}
    assert {(task.spec.labels["n_flocks"], task.spec.labels["cohesion"]) for task in tasks} == set(EVERYWHERE)


# ---- mistakes -------------------------------------------------------------------------------------------------------

WORLDS = ", ".join(beyond.STUDIES)
MISTAKES = [
    ("", "figure"),
    ("figure9", f"figure: 'figure9' is unknown; there are figure1, figure2, figure3, all, {WORLDS}, ablations"),
    ("figure2 figure3", "Unrecognized options: figure3"),
    ("figure2 --trials 0", "trials: 0 is impossible; it must be at least 1"),
    ("figure2 --trials many", "; --trials takes a whole number"),
    ("figure2 --seed -5", "seed"),
    ("figure2 --workers -1", "workers"),
    ("figure2 --timeout nan", "timeout: nan is impossible; it must be above 0 s"),
    ("figure2 --controllers", "--controllers: needs at least one value"),
    ("figure2 --controllers nobody", "controllers: 'nobody' is unknown; there are "),
    ("figure2 --controllers mine:Nobody", "controllers: mine:Nobody: module 'mine' has no 'Nobody'"),
    ("figure2 --flocks 3", "Unrecognized options: --flocks"),
    ("figure1 --literal", "--literal: goes with figure2, figure3, all, not with figure1"),
    ("figure1 --controllers idle", f"--controllers: goes with figure2, figure3, all, {WORLDS}, not with figure1"),
    ("ablations --trials 5", f"--trials: goes with figure1, figure2, figure3, all, {WORLDS}, not with ablations"),
    ("ablations --paper-hours 1", "--paper-hours: goes with figure1, not with ablations"),
    ("ablations --paper_hours=1", "--paper-hours: goes with figure1, not with ablations"),
    ("all --budget 9", "--budget: goes with figure1, ablations, not with all"),
    ("figure3 --seeds 2", "--seeds: goes with figure1, ablations, not with figure3"),
    ("figure1 --seeds 0", "seeds: 0 is impossible; it must be at least 1"),
    ("figure1 --budget many", "; --budget takes a whole number"),
    ("figure1 --paper-hours nan", "paper-hours: nan is impossible; it must be a number of at least 0"),
    ("figure1 --paper-hours -1", "paper-hours"),
    ("figure1 --paper-hours long", "; --paper-hours takes a number of hours"),
    ("figure2 --out tiny.toml", "tiny.toml: cannot be made or written"),
    ("figure2 --out used", "used: is in use by another run"),
]


@pytest.mark.parametrize(("words", "message"), MISTAKES, ids=[words for words, _ in MISTAKES])
def test_mistakes_are_one_clear_line(folder, capsys, words, message):
    with Ledger("used", __version__):
        assert main.main(["reproduce", *words.split()]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    (line,) = said.err.splitlines()
    assert line.startswith("shepherd-phys reproduce: ")
    assert message in line
    assert not Path("results").exists()


def test_without_matplotlib_nothing_is_run(folder, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert run("figure2", "--controllers", "idle") == 2
    said = capsys.readouterr()
    assert said.out == ""
    (line,) = said.err.splitlines()
    assert "the figures need matplotlib: pip install 'shepherd-phys[analysis]'" in line
    assert not Path("o").exists()


def test_a_full_disk_leaves_what_was_there(folder, capsys, monkeypatch):
    def full(fd):
        raise OSError(28, "No space left on device")

    assert run("figure2", "--controllers", "idle") == 0
    first = contents()
    capsys.readouterr()
    monkeypatch.setattr(reproduce, "write_csv", lambda *args: None)  # the pages are what does not fit
    monkeypatch.setattr("shepherd_phys.files.os.fsync", full)
    assert run("figure2", "--controllers", "idle", "--seed", "20001") == 1
    said = capsys.readouterr()
    assert said.out == ""
    (line,) = said_wrong(said.err)
    assert "o/figure2.md: cannot be written (No space left on device); no episode is lost" in line
    assert contents() == first


# ---- the front door -------------------------------------------------------------------------------------------------


def test_help_lists_every_flag(capsys):
    with pytest.raises(SystemExit) as end:
        main.main(["reproduce", "--help"])
    assert end.value.code == 0
    said = capsys.readouterr().out
    for flag in ("literal", "controllers", "trials", "seed", "workers", "timeout", "out", "json"):
        assert f"--{flag}" in said
    assert "|".join(CHOICES) in said


def test_what_is_left_out_is_the_papers():
    options = read_options(["figure3"])
    assert (options.trials, options.seed, options.out) == (100, 20_000, Path("results/reproduce"))


def test_matplotlib_is_loaded_only_to_draw():
    code = "import sys; import shepherd_phys.scripts.reproduce; print('matplotlib' in sys.modules)"
    done = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, timeout=300)
    assert done.stdout == "False\n", done.stderr


# ---- beyond the paper -----------------------------------------------------------------------------------------------


def test_beyond_runs_each_world_with_each_method(folder, monkeypatch, capsys):
    (folder / "double.toml").write_text(tomli_w.dumps({**TINY, "n_sheep": 12}))
    monkeypatch.setattr(beyond, "PAPER", {**beyond.PAPER, "scenario": "tiny.toml"})
    study = beyond.STUDIES["beyond"]
    cases = {name: study.cases[name] for name in ("1 shepherd", "n = 3")} | {"more": {"scenario": "double.toml"}}
    monkeypatch.setitem(beyond.STUDIES, "beyond", study._replace(cases=cases))
    assert run("beyond", "--controllers", "strombom", "idle", "--json") == 0
    said = json.loads(capsys.readouterr().out)["beyond"]
    table = read("o/beyond.csv")
    assert tuple(table[0]) == ("case", *summary_columns(), "ahead_mean", "ahead_low", "ahead_high", "settings_hash")
    assert {row["ahead_mean"] for row in said} == {None}
    found = [(r["case"], r["controller"], r["n_shepherds"], r["cohesion"], r["n_sheep"], r["trials"]) for r in said]
    assert found == [
        (case, method, *numbers, 2)
        for case, numbers in (("1 shepherd", (1, 40, 6)), ("n = 3", (3, 3, 6)), ("more", (3, 40, 12)))
        for method in ("strombom", "idle")
    ]
    assert [row["in_goal_end_worst"] for row in said] == [float(row["in_goal_end_worst"]) for row in table]
    page = Path("o/beyond.md").read_text("utf-8")
    assert page == study_page("beyond", study.title, study.intro, None, said)
    assert Path("o/beyond.png").read_bytes().startswith(b"\x89PNG")
    assert "| 1 shepherd | `strombom` |" in page and "2 trials a point" in page
    first = contents()
    assert run("beyond", "--controllers", "strombom", "idle") == 0  # nothing is run again
    assert contents() == first


def test_the_worlds_beyond_the_paper():
    study = beyond.STUDIES["beyond"]
    assert beyond.roster(study, ["idle"]) == ["idle"]
    assert set(beyond.roster(study, [])) <= {"occlusion", "wild", "collie"}
    double = load_scenario("double")
    assert double.n_sheep == 200 and double.goal_radius**2 == pytest.approx(2 * load_scenario("paper").goal_radius ** 2)


@pytest.mark.parametrize("name", beyond.STUDIES)
def test_every_case_of_a_study_can_be_run(name):
    study = beyond.STUDIES[name]
    cases = {title: points(controllers=["idle"], **{**beyond.PAPER, **case}) for title, case in study.cases.items()}
    hashes = {title: tasks(own, [0])[0].settings_hash for title, own in cases.items()}
    assert len(set(hashes.values())) == len(cases)  # each is another world
    for (point,) in cases.values():
        place(point, [1])


def test_a_study_tells_how_far_its_baseline_is_ahead(folder, monkeypatch, capsys):
    cases = {
        "few": {"scenario": "tiny.toml"},
        "obstacles": {"scenario": "tiny.toml", "changes": {"layout": Scattered(count=1)}},
    }
    study = beyond.STUDIES["obstacles"]._replace(cases=cases, baseline="strombom")
    monkeypatch.setitem(beyond.STUDIES, "obstacles", study)
    assert run("obstacles", "--controllers", "idle", "strombom", "--json", "--trials", "3") == 0
    said = json.loads(capsys.readouterr().out)["obstacles"]
    rows = {(row["case"], row["controller"]): row for row in said}
    for case in cases:
        assert rows[case, "strombom"]["ahead_mean"] is None
        idle, ours = rows[case, "idle"], rows[case, "strombom"]
        assert idle["ahead_mean"] == pytest.approx(ours["in_goal_end_mean"] - idle["in_goal_end_mean"])
        assert idle["ahead_low"] <= idle["ahead_mean"] <= idle["ahead_high"]
    assert rows["few", "idle"]["settings_hash"] != rows["obstacles", "idle"]["settings_hash"]
    assert "`strombom` delivers more by" in Path("o/obstacles.md").read_text("utf-8")


def test_beyond_refuses_the_flags_of_others(folder, capsys):
    assert run("beyond", "--literal") == 2
    assert "--literal: goes with figure2, figure3, all, not with beyond" in capsys.readouterr().err
    assert run("beyond", "--controllers", "nobody") == 2
    assert "'nobody' is unknown" in capsys.readouterr().err
    assert not Path("o").exists()
