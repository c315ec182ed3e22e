"""``reproduce figure1`` and ``ablations`` with runs of a few rollouts: folders, continuing, tables, time to home."""

import csv
import json
import math
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import tomli_w
from test_learning import TINY

from shepherd_phys.controllers import load_policy
from shepherd_phys.controllers.curves import COLUMNS
from shepherd_phys.controllers.policy_files import write_policy
from shepherd_phys.learning import studies
from shepherd_phys.learning.studies import Run
from shepherd_phys.scripts import main, reproduce, train
from shepherd_phys.scripts import studies as studies_of
from shepherd_phys.scripts.curves import VALIDATIONS, gather, one_by_one, read_rows
from shepherd_phys.scripts.learning_pages import ablations_page, figure1_page
from shepherd_phys.scripts.studies import HOME_COLUMNS, Reported
from shepherd_phys.scripts.studies import figure1 as study

pytest.importorskip("matplotlib")

# 3 slots x 8 decisions x 5 control steps = 120 shepherd-steps a rollout, fewer where an episode ends; two rollouts a
# checkpoint
QUICK = TINY.but(scenario=TINY.scenario.but(n_steps=30), checkpoint_rollouts=2)
JUDGED = QUICK.validation.but(flocks=(1, 2), passes=0.1)


def runs(n_seeds, budget, paper_hours=0.0):
    """Runs of wild and any and one of a paper's recipe, as `shepherd_phys.learning.studies.figure1` makes them."""
    fast = QUICK.but(budget=budget, validation=JUDGED)
    made = [
        Run(f"{reward}-{k}", "fast", fast.but(reward=reward, seed=k), timed=reward == "wild" and k < 1)
        for reward in ("wild", "any")
        for k in range(n_seeds)
    ]
    paper = QUICK.but(budget=10**9, seed=7, validation=JUDGED.but(passes=None))
    return made + ([Run("paper-wild-7", "paper", paper, paper_hours)] if paper_hours else [])


@pytest.fixture
def folder(tmp_path, monkeypatch):
    (tmp_path / "tiny.toml").write_text(tomli_w.dumps({"n_sheep": 6, "n_flocks": 2, "shepherds": 2, "n_steps": 6}))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(reproduce, "SCENARIO", "tiny.toml")
    monkeypatch.setitem(reproduce.LEAST, "workers", 0)
    monkeypatch.setattr(studies, "figure1", runs)
    monkeypatch.setattr(studies, "FIGURE1", JUDGED)
    monkeypatch.setattr("shepherd_phys.learning.validation.Validator.passes", lambda self, rows: True)
    monkeypatch.setattr("shepherd_phys.scripts.curves.HOME", 0.0)
    return tmp_path


def figure1(*words, budget=480):
    command = ["reproduce", "figure1", "--seeds", "1", "--budget", str(budget), "--trials", "2", "--workers", "0"]
    return main.main([*command, "--paper-hours", "0", "--out", "o", *words])


def read(name):
    with open(Path("o") / name, newline="") as file:
        return list(csv.DictReader(file))


def test_figure_1_from_nothing_and_again(folder, capsys, monkeypatch):
    assert figure1("--json") == 0
    said = capsys.readouterr()
    assert sorted(path.name for path in Path("o/training").iterdir()) == ["any-0", "wild-0"]
    for name in ("preset.toml", "curve.csv", "validation.csv", "checkpoints", "policy.json", "first.json"):
        assert Path("o/training/wild-0", name).exists()
    files = ["claims.json", "claims.md", "figure1-validation.csv", "figure1.csv", "figure1.md", "figure1.png",
             "time-to-home.csv"]  # fmt: skip
    assert sorted(path.name for path in Path("o").iterdir() if path.suffix in {".csv", ".md", ".png", ".json"}) == files

    curves = read_rows(Path("o/figure1.csv"), COLUMNS)
    assert tuple(read("figure1.csv")[0]) == COLUMNS
    assert [row["reward"] for row in curves] == sorted((row["reward"] for row in curves), reverse=True)  # wild first
    for reward in ("wild", "any"):
        own = [row for row in curves if row["reward"] == reward]
        last = read(f"training/{reward}-0/curve.csv")[-1]
        assert own[-1]["shepherd_steps"] == int(last["shepherd_steps"]) and int(last["rollout"]) == 4
        assert own[-1]["decisions"] == int(last["decisions"]) and own[-1]["seconds"] == float(last["seconds"])
        assert all(row["episode_reward"] is not None for row in own[:-1])
    checks = read_rows(Path("o/figure1-validation.csv"), VALIDATIONS)
    assert [(row["checkpoint"], row["n_flocks"]) for row in checks if row["reward"] == "wild"] == [
        (1, 1), (1, 2), (2, 1), (2, 2),
    ]  # fmt: skip
    home = read_rows(Path("o/time-to-home.csv"), HOME_COLUMNS)
    assert [(row["seed"], row["checkpoint"], row["n_flocks"], row["trials"]) for row in home] == [
        (0, 1, 1, 2),
        (0, 1, 2, 2),
    ]
    (reached,) = {row["shepherd_steps"] for row in home}
    assert load_policy("o/training/wild-0/first.json").spec.training["shepherd_steps"] == reached
    assert all(0 <= row["confirmed_low"] <= row["confirmed_mean"] <= row["confirmed_high"] <= 100 for row in home)
    assert {row["seconds"] for row in home} == {row["seconds"] for row in checks[:2]}
    assert Path("o/figure1.md").read_text("utf-8") == figure1_page(curves, checks, home)
    told = json.loads(said.out)
    assert told["time_to_home"] == home and told["claims"] == json.loads(Path("o/claims.json").read_text("utf-8"))
    assert [claim["claim"] for claim in told["claims"]["claims"]] == [f"c{i}" for i in range(1, 9)]
    assert told["claims"]["claims"][-1]["parts"][0]["note"] == "fewer than 3 seeds"
    assert "wild-0: validation at" in said.err

    before = {path.name: path.read_bytes() for path in Path("o").iterdir() if path.suffix in {".csv", ".md", ".json"}}
    monkeypatch.setattr("shepherd_phys.scripts.curves._train", None)  # nothing is left to be trained, or played
    monkeypatch.setattr("shepherd_phys.campaign.attempt", None)
    monkeypatch.setattr(train, "LIBRARIES", ("no_such_library",))  # nor is a library needed
    assert figure1() == 0
    assert {name: Path("o", name).read_bytes() for name in before} == before
    assert "| fast | wild | 1 |" in capsys.readouterr().out


def test_figure_1_goes_on_after_a_stop_and_becomes_longer(folder, capsys, monkeypatch):
    def stop(now):
        if now.validation:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("shepherd_phys.scripts.curves._teller", lambda name: stop)
        assert figure1("--paper-hours", "1e-9", budget=240) == 130
    assert "stopped; what was done is kept in o: the same command continues" in capsys.readouterr().err
    assert [path.name for path in Path("o/training").iterdir()] == ["wild-0"]
    assert not Path("o/figure1.csv").exists()
    assert figure1("--paper-hours", "1e-9", budget=240) == 0
    short = read_rows(Path("o/figure1.csv"), COLUMNS)
    first = load_policy("o/training/wild-0/first.json").checksum
    assert {row["recipe"] for row in short} == {"fast", "paper"}
    assert len(read("training/paper-wild-7/curve.csv")) == 2  # its time was over at once
    assert [row["checkpoint"] for row in read("training/paper-wild-7/validation.csv")] == ["1", "1"]
    assert figure1(budget=480) == 0
    assert max(row["rollout"] for row in read_rows(Path("o/figure1.csv"), COLUMNS)) == 4
    assert load_policy("o/training/wild-0/first.json").checksum == first  # the first stays the first
    assert load_policy("o/training/wild-0/policy.json").checksum != first
    assert figure1("--paper-hours", "1e-9", budget=240) == 0  # and a shorter look at the longer runs
    assert read_rows(Path("o/figure1.csv"), COLUMNS) == short


def test_timed_runs_are_trained_alone_and_the_others_side_by_side(folder, monkeypatch, capsys):
    told = []

    def watched(how):
        def train_them(runs, training, workers):
            told.append((how, [run.name for run in runs], workers))
            return one_by_one(runs, training, 1)

        return train_them

    for how in ("one_by_one", "side_by_side"):
        monkeypatch.setattr(f"shepherd_phys.scripts.studies.{how}", watched(how))
    reported = Reported("tiny.toml", 1, 20_000, 0, 60.0)
    result = study(Path("o"), n_seeds=2, budget=120, paper_hours=1e-9, workers=3, reported=reported)
    beside = ["wild-1", "any-0", "any-1", "paper-wild-7"]
    assert told == [("one_by_one", ["wild-0"], 3), ("side_by_side", beside, 3)]
    assert {row["seed"] for row in result.tables["time_to_home"]} == {0}
    schemes = dict.fromkeys((row["recipe"], row["reward"]) for row in read_rows(Path("o/figure1.csv"), COLUMNS))
    assert list(schemes) == [("fast", "wild"), ("fast", "any"), ("paper", "wild")]


def test_what_an_interrupted_study_has_is_enough_for_fewer_seeds(folder, monkeypatch, capsys):
    def stop(now):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(
            "shepherd_phys.scripts.curves._teller", lambda name: stop if name == "any-1" else lambda now: None
        )
        assert figure1("--seeds", "2", budget=120) == 130
    assert sorted(path.name for path in Path("o/training").iterdir()) == ["any-0", "any-1", "wild-0", "wild-1"]
    monkeypatch.setattr("shepherd_phys.scripts.curves._train", None)  # nothing is left to be trained
    assert figure1(budget=120) == 0
    assert {row["seed"] for row in read("figure1.csv")} == {"0"}
    assert "| fast | any | 1 |" in Path("o/figure1.md").read_text("utf-8")


def test_policies_that_a_kill_left_out_are_written_again(folder, monkeypatch, capsys):
    assert figure1(budget=120) == 0
    before = {path: path.read_bytes() for path in Path("o/training").rglob("*.json")}
    assert {path.name for path in before} == {"policy.json", "best.json", "first.json"}
    curve = Path("o/training/any-0/curve.csv").read_bytes()
    Path("o/training/any-0/policy.json").unlink()
    Path("o/training/any-0/best.safetensors").write_bytes(b"torn")
    Path("o/training/wild-0/first.safetensors").unlink()
    capsys.readouterr()
    assert figure1(budget=120) == 0
    assert {path: path.read_bytes() for path in Path("o/training").rglob("*.json")} == before
    for path in before:
        load_policy(path)
    assert Path("o/training/any-0/curve.csv").read_bytes() == curve


def test_a_finished_run_can_be_kept_without_its_checkpoints(folder, capsys, monkeypatch):
    assert figure1("--paper-hours", "1e-9") == 0
    before = {path.name: path.read_bytes() for path in Path("o").iterdir() if path.suffix in {".csv", ".md", ".json"}}
    kept = {"preset.toml", "curve.csv", "validation.csv", "first.json", "first.safetensors"}
    for path in list(Path("o/training").glob("*/*")):
        if path.name not in kept or (path.stem == "first" and path.parent.name != "wild-0"):
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    with monkeypatch.context() as patch:
        patch.setattr("shepherd_phys.scripts.curves._train", None)  # nothing is left to be trained
        assert figure1("--paper-hours", "1e-9") == 0
        assert {name: Path("o", name).read_bytes() for name in before} == before
    again = []

    def train_it(run, place, workers):
        again.append(run.name)
        return "not now"

    monkeypatch.setattr("shepherd_phys.scripts.curves._train", train_it)
    assert figure1("--paper-hours", "1e-9", budget=720) == 1
    assert again == ["wild-0", "any-0"]  # longer, they are not whole; the paper's run has a time
    again.clear()
    Path("o/training/wild-0/first.safetensors").unlink()  # which its reported trials need
    rows = Path("o/training/any-0/validation.csv").read_text().splitlines()
    Path("o/training/any-0/validation.csv").write_text("\n".join(rows[:-1]) + "\n")  # the end is not judged whole
    Path("o/training/paper-wild-7/curve.csv").unlink()
    assert figure1("--paper-hours", "1e-9") == 1
    assert again == ["wild-0", "any-0", "paper-wild-7"]


def test_claims_that_were_judged_while_it_trained_are_kept(folder, capsys, monkeypatch):
    assert figure1("--paper-hours", "0") == 0
    claims = json.loads(Path("o/claims.json").read_text("utf-8"))
    real = studies_of.gather

    def meanwhile(*args):
        claims["claims"][0]["verdict"] = "holds"  # figure 2 has ended in the same folder
        Path("o/claims.json").write_text(json.dumps(claims))
        return real(*args)

    monkeypatch.setattr(studies_of, "gather", meanwhile)
    assert figure1("--paper-hours", "0") == 0
    assert json.loads(Path("o/claims.json").read_text("utf-8"))["claims"][0]["verdict"] == "holds"


def test_a_kept_first_policy_is_that_of_the_validation_that_passed(folder, capsys, monkeypatch):
    assert figure1("--paper-hours", "1e-9") == 0
    shutil.rmtree("o/training/wild-0/checkpoints")
    again = []
    monkeypatch.setattr("shepherd_phys.scripts.curves._train", lambda run, *_: again.append(run.name) or "not now")
    assert figure1("--paper-hours", "1e-9") == 0 and again == []
    first = load_policy("o/training/wild-0/first.json")
    training = {**first.spec.training, "shepherd_steps": first.spec.training["shepherd_steps"] + 1}
    write_policy("o/training/wild-0/first.json", replace(first.spec, training=training), first.weights)
    assert figure1("--paper-hours", "1e-9") == 1 and again == ["wild-0"]


def test_a_folder_with_other_settings_is_left_alone(folder, capsys):
    (run,) = runs(1, 240)[:1]
    Path("o/training/wild-0").mkdir(parents=True)
    run.preset.but(worlds=1, team_sizes=(3,)).to_toml("o/training/wild-0/preset.toml")
    before = Path("o/training/wild-0/preset.toml").read_bytes()
    assert figure1(budget=240) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert (
        "o/training/wild-0: holds a run with other settings: team_sizes is [3] there, [1, 2] here; worlds is 1 there, "
        "2 here; another --out begins anew"
    ) in line
    assert Path("o/training/wild-0/preset.toml").read_bytes() == before


def test_without_the_libraries_nothing_is_begun(folder, capsys, monkeypatch):
    monkeypatch.setattr(train, "LIBRARIES", ("torch", "no_such_library"))
    assert figure1() == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line == "shepherd-phys reproduce: no_such_library is missing: pip install 'shepherd-phys[train]'"
    assert not Path("o").exists()


def test_broken_claims_are_one_line(folder, capsys):
    Path("o").mkdir()
    Path("o/claims.json").write_text('{"claims": 3}')
    assert figure1() == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "o/claims.json: is not what reproduce writes" in line


def test_a_run_that_fails_is_named_and_the_others_go_on(folder, capsys, monkeypatch):
    from shepherd_phys.learning import run
    from shepherd_phys.learning.ppo import TrainingError

    real = run.train

    def fails(place, *more):
        if place.name == "wild-0":
            raise TrainingError("rewards: holds a NaN or an infinity: training stops")
        return real(place, *more)

    monkeypatch.setattr(run, "train", fails)
    assert figure1(budget=120) == 1
    assert "shepherd-phys reproduce: wild-0: rewards: holds a NaN" in capsys.readouterr().err
    assert {row["reward"] for row in read("figure1.csv")} == {"any"}
    assert read("time-to-home.csv") == []


def test_the_other_figures_judge_the_curves_that_are_there(folder, capsys):
    curves = [
        {"recipe": "fast", "reward": reward, "seed": seed, "rollout": k, "shepherd_steps": k * 1000, "decisions": k,
         "seconds": 1.0, "episode_reward": float(k > at), "in_goal_end": 0.0, "path_length": 0.0}
        for reward, at in (("wild", 5), ("any", 15))
        for seed in range(3)
        for k in range(1, 31)
    ]  # fmt: skip
    Path("o").mkdir()
    with open("o/figure1.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(curves)
    command = ["reproduce", "figure2", "--controllers", "idle", "--trials", "1", "--workers", "0", "--out", "o"]
    assert main.main(command) == 0
    report = json.loads(Path("o/claims.json").read_text("utf-8"))
    assert report["claims"][-1]["verdict"] == "holds"
    assert "recipe fast" in Path("o/claims.md").read_text("utf-8")
    capsys.readouterr()
    Path("o/figure1.csv").write_text("recipe,reward\nfast,wild\n")
    assert main.main(command) == 2
    assert "o/figure1.csv: is not the table that it should be" in capsys.readouterr().err


DRIVER = """
import sys
from test_studies import QUICK
from shepherd_phys.learning import studies
from shepherd_phys.scripts import main
kinds = {"base": QUICK, "base-team-credit": QUICK.but(credit="team")}
studies.variants = lambda: kinds
studies.ABLATIONS = QUICK.validation.but(every=1_000_000)
if __name__ == "__main__":
    sys.exit(main.main(sys.argv[1:]))
"""


def check_ablations(out, said, progress):
    """What one seed of the two variants of the driver must have left in ``out``."""
    names = ["ablation-base-1000000", "ablation-base-team-credit-1000000"]
    assert sorted(path.name for path in (out / "training").iterdir()) == names
    curves = read_rows(out / "ablations.csv", COLUMNS)
    assert list(dict.fromkeys((row["recipe"], row["seed"]) for row in curves)) == [
        ("base", 1_000_000),
        ("base-team-credit", 1_000_000),
    ]
    checks = read_rows(out / "ablations-validation.csv", VALIDATIONS)
    assert [(row["recipe"], row["n_flocks"]) for row in checks] == [("base", 1), ("base-team-credit", 1)]  # at the end
    page = ablations_page(curves, checks)
    assert (out / "ablations.md").read_text("utf-8") == page
    assert said.startswith(page) and said.splitlines()[-1] == "o/ablations.png"
    assert (out / "ablations.png").read_bytes().startswith(b"\x89PNG")
    assert "ablation-base-1000000: validation at" in progress
    assert not (out / "claims.json").exists()


ABLATIONS = ["reproduce", "ablations", "--seeds", "1", "--budget", "300", "--out", "o"]


def test_the_ablations_one_after_another(folder, capsys, monkeypatch):
    kinds = {"base": QUICK, "base-team-credit": QUICK.but(credit="team")}
    monkeypatch.setattr(studies, "variants", lambda: kinds)
    monkeypatch.setattr(studies, "ABLATIONS", QUICK.validation.but(every=1_000_000))
    assert main.main([*ABLATIONS, "--workers", "1"]) == 0
    said = capsys.readouterr()
    check_ablations(Path("o"), said.out, said.err)
    training = Path("o/training")
    wanted = studies.ablations(1, 300)
    (each, _), (pairs, _) = gather(wanted, training), gather(wanted, training, 2 * QUICK.rollout_steps)
    one, both = ([row for row in rows if row["recipe"] == "base"] for rows in (each, pairs))
    assert (len(one), len(both)) == (len(one), math.ceil(len(one) / 2))
    assert both[0]["episode_reward"] == sum(row["episode_reward"] for row in one[:2]) / 2
    assert both[0]["shepherd_steps"] == one[1]["shepherd_steps"]


@pytest.mark.slow
def test_the_ablations_side_by_side_in_a_shell(tmp_path):
    (tmp_path / "driver.py").write_text(DRIVER)
    done = subprocess.run(
        [sys.executable, "driver.py", *ABLATIONS, "--workers", "2"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parent)},
        capture_output=True,
        text=True,
        timeout=400,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    check_ablations(tmp_path / "o", done.stdout, done.stderr)


def test_a_mistake_in_a_shell_is_one_line(tmp_path):
    words = ["reproduce", "figure1", "--literal"]
    done = subprocess.run(
        [Path(sys.executable).with_name("shepherd-phys"), *words],
        cwd=tmp_path, capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (2, "")
    (line,) = done.stderr.splitlines()
    assert line == "shepherd-phys reproduce: --literal: goes with figure2, figure3, all, not with figure1"
    assert os.listdir(tmp_path) == []
