"""Training runs: killed and resumed they equal the unbroken one; checkpoints are whole or not there."""

import ast
import contextlib
import csv
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import safetensors.numpy
from test_learning import TINY

from shepherd_phys.controllers import load_policy
from shepherd_phys.controllers.policy_files import write_policy
from shepherd_phys.envs.rewards import Effort
from shepherd_phys.learning import checkpoints, run
from shepherd_phys.learning.checkpoints import Checkpoint, CheckpointError
from shepherd_phys.learning.folder import CURVE_COLUMNS, Table, alone, begin, exported
from shepherd_phys.learning.preset import Preset, load_preset
from shepherd_phys.learning.run import train
from shepherd_phys.learning.validation import ValidationError, Validator
from shepherd_phys.scripts.train import main as train_main
from shepherd_phys.settings import SettingsError

# 3 slots x 8 decisions x 5 control steps = 120 a rollout, a few fewer where an episode is cut short; 2 rollouts a
# checkpoint: 600 is three whole intervals
PRESET = TINY.but(budget=600)


KILLS = int(os.environ.get("KILLS", "50"))
"""Of the test that kills by force; the environment may ask for more."""


@dataclass(frozen=True)
class Near:
    """A reward term of a user's own."""

    reach: float = float("inf")

    def __call__(self, before, after, scan, scenario):
        return 0.0


class Killed(Exception):
    """What the runs below die of."""


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory):
    folder = tmp_path_factory.mktemp("unbroken") / "run"
    begin(folder, PRESET)
    train(folder)
    return folder


def rows_of(path):
    with open(path, newline="", encoding="utf-8") as file:
        return [{k: v for k, v in row.items() if k != "seconds"} for row in csv.DictReader(file)]


def assert_same_run(a, b):
    """To the bit: parameters, Adam's moments, the normaliser, counters, the best policy; and the tables."""
    one, other = checkpoints.load_latest(a / "checkpoints"), checkpoints.load_latest(b / "checkpoints")
    assert one.number == other.number >= 3
    assert set(one.arrays) == set(other.arrays)
    for name, array in one.arrays.items():
        np.testing.assert_array_equal(array, other.arrays[name], err_msg=name)
    assert {**one.facts, "seconds": 0} == {**other.facts, "seconds": 0}
    for name in ("curve.csv", "validation.csv"):
        assert rows_of(a / name) == rows_of(b / name)
    for name in ("policy.json", "best.json"):
        assert load_policy(a / name).checksum == load_policy(b / name).checksum


def train_and_die(folder, rollouts):
    """Train for so many rollouts and go no further."""
    seen = []

    def report(progress):
        seen.append(progress)
        if sum(not p.validation for p in seen) >= rollouts:
            raise Killed

    with pytest.raises(Killed):
        train(folder, report=report)


@pytest.mark.parametrize("rollouts", [1, 2, 3, 5])
def test_a_run_that_was_stopped_and_resumed_is_the_unbroken_one(rollouts, unbroken, tmp_path):
    begin(tmp_path, PRESET)
    train_and_die(tmp_path, rollouts)
    train(tmp_path)
    assert_same_run(tmp_path, unbroken)


KILLER = """
import os, random, signal, sys, time
from pathlib import Path

from shepherd_phys.learning.folder import begin
from shepherd_phys.learning.preset import Preset
from shepherd_phys.learning.run import train

here, kills = Path(sys.argv[1]), int(sys.argv[2])
preset = Preset.from_toml(here / "preset.toml")
rng = random.Random(7)


def die():
    os.kill(os.getpid(), signal.SIGKILL)


def die_in_a_save(after, late):
    # at one of the next writings or renamings of a file: in its middle, or right after it
    real_write, real_replace, left = Path.write_bytes, Path.replace, [after]

    def counted():
        left[0] -= 1
        return left[0] < 0

    def write(path, data):
        if counted():
            real_write(path, data if late else data[: len(data) // 2])
            die()
        return real_write(path, data)

    def replace(path, target):
        if counted():
            if late:
                real_replace(path, target)
            die()
        return real_replace(path, target)

    Path.write_bytes, Path.replace = write, replace


killed = {"anywhere": 0, "in a save": 0}
runs = 0
while sum(killed.values()) < kills:
    folder = here / str(runs)
    if not folder.exists():
        begin(folder, preset)
    kind, after, late, seconds = rng.choice(list(killed)), rng.randrange(14), rng.random() < 0.5, rng.uniform(0.0, 4.0)
    child = os.fork()
    if child == 0:
        if kind == "in a save":
            die_in_a_save(after, late)
        try:
            train(folder)
        except BaseException as error:
            print(f"{kind}: {error!r}", flush=True)
            os._exit(1)
        os._exit(0)
    if kind == "anywhere":
        time.sleep(seconds)
        os.kill(child, signal.SIGKILL)
    status = os.waitpid(child, 0)[1]
    if os.WIFSIGNALED(status):
        killed[kind] += 1
    elif os.WEXITSTATUS(status):
        sys.exit(1)
    else:
        runs += 1
if folder.exists():
    train(folder)
print(killed)
"""


@pytest.mark.slow
def test_a_run_that_is_killed_at_random_moments_always_goes_on_and_is_the_unbroken_one(tmp_path):
    preset = TINY.but(budget=2400)
    begin(tmp_path / "unbroken", preset)
    train(tmp_path / "unbroken")
    preset.to_toml(tmp_path / "preset.toml")
    done = subprocess.run(
        [sys.executable, "-P", "-c", KILLER, str(tmp_path), str(KILLS)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr[-2000:]
    killed = ast.literal_eval(done.stdout.splitlines()[-1])
    assert sum(killed.values()) == KILLS and min(killed.values()) > KILLS // 5
    runs = [folder for folder in tmp_path.iterdir() if folder.name.isdigit()]
    assert runs
    for folder in runs:
        assert_same_run(folder, tmp_path / "unbroken")


@pytest.mark.slow
def test_worker_processes_change_nothing(unbroken, tmp_path):
    begin(tmp_path, PRESET)
    train(tmp_path, n_workers=2)
    assert_same_run(tmp_path, unbroken)


def test_seconds_and_pace_are_of_training_alone(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(run, "time", SimpleNamespace(monotonic=lambda: now[0]))
    clock = run._Clock(seconds=7.0, shepherd_steps=1000)  # of earlier processes
    now[0] += 10.0
    with clock.stopped():
        now[0] += 500.0
    now[0] += 10.0
    assert (clock.seconds(), clock.rate(1400)) == (27.0, 20.0)


def test_a_run_validates_while_its_clock_stands_still(tmp_path, monkeypatch):
    """The clock is one that only a validation moves on: no time passes for the curve."""
    now = [0.0]
    monkeypatch.setattr(run, "time", SimpleNamespace(monotonic=lambda: now[0]))
    judge = Validator.__call__

    def slow(self, policy):
        now[0] += 1000.0
        return judge(self, policy)

    monkeypatch.setattr(Validator, "__call__", slow)
    begin(tmp_path, PRESET)
    train(tmp_path)
    assert now[0] >= 2000.0
    with open(tmp_path / "curve.csv", newline="", encoding="utf-8") as file:
        assert {float(row["seconds"]) for row in csv.DictReader(file)} == {0.0}


def test_what_passes_is_every_point():
    rows = [{"in_goal_end": 97.0}, {"in_goal_end": 96.9}]
    asked = Validator(PRESET.but(validation=PRESET.validation.but(passes=97.0)))
    assert asked.passes(rows[:1]) and not asked.passes(rows)
    assert not Validator(PRESET).passes(rows)


def test_another_seed_is_another_run(unbroken, tmp_path):
    begin(tmp_path, PRESET.but(seed=2_000_000, budget=120))
    train(tmp_path)
    assert rows_of(tmp_path / "curve.csv")[0] != rows_of(unbroken / "curve.csv")[0]


def test_what_a_run_leaves(unbroken):
    names = {path.name for path in unbroken.iterdir()}
    assert names == {
        "preset.toml", "run.lock", "curve.csv", "validation.csv", "checkpoints", "tensorboard",
        "policy.json", "policy.safetensors", "best.json", "best.safetensors",
    }  # fmt: skip
    assert load_preset(unbroken / "preset.toml") == PRESET
    assert sorted(os.listdir(unbroken / "checkpoints")) == [f"checkpoint-00000{i}.safetensors" for i in (2, 3)]
    assert [path.name for path in (unbroken / "tensorboard").iterdir()]
    curve = rows_of(unbroken / "curve.csv")
    assert [int(row["rollout"]) for row in curve] == list(range(1, len(curve) + 1))
    assert len(curve) == PRESET.n_rollouts == 6
    steps = [int(row["shepherd_steps"]) for row in curve]
    assert steps == sorted(steps) and 0.9 * 720 <= steps[-1] <= 720
    rewards = [row["episode_reward"] for row in curve]
    assert any(rewards) and all(text == "" or np.isfinite(float(text)) for text in rewards)
    checked = rows_of(unbroken / "validation.csv")
    assert [row["checkpoint"] for row in checked] == ["1", "2", "3"]
    assert load_policy(unbroken / "best.json").spec.training["shepherd_steps"] in [
        int(row["shepherd_steps"]) for row in checked
    ]
    assert load_policy(unbroken / "policy.json").spec.training["shepherd_steps"] == steps[-1]


def test_a_finished_run_is_not_trained_further(unbroken, tmp_path):
    before = checkpoints.load_latest(unbroken / "checkpoints")
    train(unbroken)
    after = checkpoints.load_latest(unbroken / "checkpoints")
    assert after.facts == before.facts


def test_a_smaller_budget_leaves_a_longer_run_as_it_is(unbroken, tmp_path, monkeypatch):
    shutil.copytree(unbroken, tmp_path / "run")
    names = [path.name for path in unbroken.iterdir() if path.suffix in {".csv", ".json", ".safetensors", ".toml"}]
    monkeypatch.setattr("shepherd_phys.controllers.policy_files.__version__", "99")  # nor does a later version
    train(tmp_path / "run", preset=PRESET.but(budget=240))
    train(tmp_path / "run")
    for name in names:
        assert (tmp_path / "run" / name).read_bytes() == (unbroken / name).read_bytes(), name


def test_a_run_that_ends_sooner_goes_on_as_the_longer_one(unbroken, tmp_path):
    begin(tmp_path, PRESET)
    seen = []
    train(tmp_path, preset=PRESET.but(budget=240), report=seen.append)
    assert len(rows_of(tmp_path / "curve.csv")) == 2 and {told.length for told in seen} == {240}
    assert [told.done for told in seen] == [0.5, 1.0, 1.0]  # the last of the validation
    assert Preset.from_toml(tmp_path / "preset.toml") == PRESET
    assert load_policy(tmp_path / "policy.json").spec.training["budget"] == PRESET.budget
    train(tmp_path)
    assert_same_run(tmp_path, unbroken)


@pytest.mark.parametrize(("short", "every"), [(1, 1), (240, 1), (241, 1), (1, 2), (500, 2), (481, 4), (481, 3)])
def test_a_run_that_is_made_longer_is_the_one_that_was_longer_from_the_start(short, every, tmp_path):
    """Whether or not the end of the shorter one was a validation's turn."""
    preset = PRESET.but(budget=900, validation=PRESET.validation.but(every=every, passes=0.001))
    begin(tmp_path / "long", preset)
    train(tmp_path / "long")
    begin(tmp_path / "short", preset.but(budget=short))
    train(tmp_path / "short")
    train(tmp_path / "short", preset=preset)
    assert_same_run(tmp_path / "short", tmp_path / "long")
    assert sorted(os.listdir(tmp_path / "short")) == sorted(os.listdir(tmp_path / "long"))


def test_a_run_whose_way_back_is_gone_is_not_made_longer(tmp_path):
    preset = PRESET.but(budget=480, validation=PRESET.validation.but(every=9))
    begin(tmp_path, preset)
    train(tmp_path)
    (tmp_path / "checkpoints" / "checkpoint-000001.safetensors").unlink()
    before = rows_of(tmp_path / "validation.csv")
    with pytest.raises(CheckpointError, match="the one before, from which a longer run goes on, is not there whole"):
        train(tmp_path, preset=preset.but(budget=600))
    assert load_policy(tmp_path / "best.json") and rows_of(tmp_path / "validation.csv") == before
    assert Preset.from_toml(tmp_path / "preset.toml") == preset


def test_a_run_ends_with_whole_intervals_of_its_budget():
    lengths = [TINY.but(budget=budget).n_rollouts for budget in (1, 239, 240, 241, 600)]
    assert lengths == [2, 2, 2, 4, 6]
    assert TINY.but(budget=241, checkpoint_rollouts=1).n_rollouts == 3


def test_time_that_is_up_ends_a_run_with_an_interval(tmp_path):
    begin(tmp_path, PRESET)
    train(tmp_path, seconds=1e-9)
    assert [row["rollout"] for row in rows_of(tmp_path / "curve.csv")] == ["1", "2"]
    train(tmp_path, seconds=1e-9)
    assert checkpoints.load_latest(tmp_path / "checkpoints").number == 1


def test_tensorboard_shows_each_rollout_once(unbroken, tmp_path):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    def shown(folder):
        events = EventAccumulator(str(folder / "tensorboard"))
        events.Reload()
        return {tag: [(e.step, e.value) for e in events.Scalars(tag)] for tag in events.Tags()["scalars"]}

    begin(tmp_path, PRESET)
    for rollouts in (1, 3, 2):  # the first of these processes dies before there is a checkpoint
        train_and_die(tmp_path, rollouts)
    train(tmp_path)
    curve = rows_of(tmp_path / "curve.csv")
    whole = shown(tmp_path)
    assert whole == shown(unbroken)
    assert "train/n_updates" not in whole  # as stable-baselines3 has it
    assert [step for step, _ in whole["time/shepherd_steps"]] == [int(row["decisions"]) for row in curve]
    assert [value for _, value in whole["train/value_loss"]] == pytest.approx(
        [float(row["value_loss"]) for row in curve]
    )
    assert [step for step, _ in whole["validation/score"]] == [int(row["decisions"]) for row in curve[1::2]]


def test_nobody_else_trains_in_the_folder(unbroken, tmp_path):
    with alone(unbroken), pytest.raises(SettingsError, match="another process trains in it"):
        train(unbroken)
    with alone(tmp_path), pytest.raises(SettingsError, match="another process trains in it"):
        begin(tmp_path, PRESET)


def test_while_somebody_trains_the_run_stays_what_it_is(unbroken, capsys):
    before = (unbroken / "preset.toml").read_bytes()
    with alone(unbroken):
        assert train_main(["--resume", "--out", str(unbroken), "--budget", "9000"]) == 2
    assert "another process trains in it" in capsys.readouterr().err
    assert (unbroken / "preset.toml").read_bytes() == before


@pytest.mark.parametrize("lost", ["policy.json", "policy.safetensors", "best.json", "best.safetensors"])
def test_a_finished_run_gets_its_policies_back(lost, unbroken, tmp_path):
    """As when it was killed between its last checkpoint and the export, or within."""
    shutil.copytree(unbroken, tmp_path / "run")
    saved = checkpoints.load_latest(unbroken / "checkpoints")
    assert exported(tmp_path / "run", saved)
    (tmp_path / "run" / lost).write_bytes((unbroken / lost).read_bytes()[:100])
    assert not exported(tmp_path / "run", saved)
    train(tmp_path / "run")
    assert exported(tmp_path / "run", saved)
    assert_same_run(tmp_path / "run", unbroken)


def test_policies_of_an_earlier_checkpoint_are_not_the_last_ones(unbroken):
    saved = checkpoints.load_latest(unbroken / "checkpoints")
    later = Checkpoint(4, saved.arrays, {**saved.facts, "shepherd_steps": saved.facts["shepherd_steps"] + 1})
    assert exported(unbroken, saved) and not exported(unbroken, later)
    assert not exported(unbroken, Checkpoint(4, saved.arrays, {**saved.facts, "first": {"shepherd_steps": 1}}))


@pytest.mark.parametrize("left", ["all", "tables"])
def test_a_run_whose_checkpoints_are_gone_keeps_what_it_has_written(left, unbroken, tmp_path, capsys):
    shutil.copytree(unbroken, tmp_path / "run", ignore=shutil.ignore_patterns("checkpoints"))
    if left == "tables":
        for name in ("policy.json", "policy.safetensors", "best.json", "best.safetensors"):
            (tmp_path / "run" / name).unlink()
    before = {path.name: path.read_bytes() for path in (tmp_path / "run").iterdir() if path.is_file()}
    assert train_main(["--resume", "--out", str(tmp_path / "run")]) == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert f"{tmp_path / 'run'}: holds 6 rollouts in curve.csv and no checkpoint to go on from" in said
    assert {path.name: path.read_bytes() for path in (tmp_path / "run").iterdir() if path.is_file()} == before


@pytest.mark.parametrize("stopped_in", [1, 3])
def test_who_resumes_is_told_where_from(stopped_in, unbroken, tmp_path, monkeypatch, capsys):
    """Of rollouts, two make a checkpoint."""
    begin(tmp_path / "run", PRESET)
    words = ["--resume", "--out", str(tmp_path / "run"), "--workers", "1"]

    def stop(now):
        if round(now.done * PRESET.n_rollouts) == stopped_in:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("shepherd_phys.scripts.train.progress_bar", lambda: contextlib.nullcontext(stop))
        assert train_main(words) == 130
    told = "goes on from the last checkpoint" if stopped_in > 2 else "begins anew: there is no checkpoint yet"
    assert capsys.readouterr().err.splitlines()[-1].endswith(f"stopped: --resume --out {tmp_path / 'run'} {told}")
    assert train_main(words) == 0
    begun = "no checkpoint yet, the first comes after 240 shepherd-steps: it begins anew"
    assert (begun in capsys.readouterr().err) == (stopped_in < 2)
    assert_same_run(tmp_path / "run", unbroken)


def test_a_run_goes_on_after_an_upgrade_that_knows_more_settings(unbroken, tmp_path):
    shutil.copytree(unbroken, tmp_path / "run")
    saved = checkpoints.load_latest(unbroken / "checkpoints")
    settings = {name: value for name, value in saved.facts["settings"].items() if name != "learns_mirrored"}
    assert settings != saved.facts["settings"]
    checkpoints.save(
        tmp_path / "run" / "checkpoints",
        Checkpoint(saved.number, saved.arrays, {**saved.facts, "settings": {**settings, "seed": 3}}),
    )
    with pytest.raises(SettingsError, match=f": seed, now {PRESET.seed}, was 3. Undo that"):
        train(tmp_path / "run")
    checkpoints.save(
        tmp_path / "run" / "checkpoints",
        Checkpoint(saved.number, saved.arrays, {**saved.facts, "settings": settings}),
    )
    train(tmp_path / "run")


def test_a_validation_that_fails_costs_nothing_learned(unbroken, tmp_path, monkeypatch):
    begin(tmp_path, PRESET)
    judge, tried = Validator.__call__, []

    def failing(self, policy):
        tried.append(policy)
        if len(tried) in (2, 3):
            raise ValidationError("validation, seed 7: died")
        return judge(self, policy)

    monkeypatch.setattr(Validator, "__call__", failing)
    for _ in range(2):  # the second time it fails before anything is learned
        with pytest.raises(ValidationError, match="seed 7: died"):
            train(tmp_path)
        assert len(rows_of(tmp_path / "curve.csv")) == 4 and len(rows_of(tmp_path / "validation.csv")) == 1
        saved = checkpoints.load_latest(tmp_path / "checkpoints")
        assert (saved.number, saved.facts["unjudged"]) == (2, True)
    train(tmp_path)
    assert len(tried) == 5
    assert_same_run(tmp_path, unbroken)


def test_a_validation_of_this_process_says_in_one_line_where_it_failed(tmp_path, monkeypatch):
    def broken(play, seed):
        raise ZeroDivisionError("of a user's own")

    monkeypatch.setattr("shepherd_phys.learning.validation.episode", broken)
    begin(tmp_path, PRESET)
    with pytest.raises(ValidationError, match=r"validation, seed \d+: ZeroDivisionError: of a user's own \(test_lea"):
        train(tmp_path)


def test_a_run_begins_with_the_policy_that_was_there_when_it_was_made(tmp_path):
    for k in (0, 1):
        begin(tmp_path / str(k), TINY.but(seed=5 + k, budget=1))
        train(tmp_path / str(k))
    fine = PRESET.but(budget=240, init=str(tmp_path / "init.json"), critic_first=9)
    for kind in ("json", "safetensors"):
        shutil.copy(tmp_path / "0" / f"policy.{kind}", tmp_path / f"init.{kind}")
    begin(tmp_path / "run", fine)
    for kind in ("json", "safetensors"):
        shutil.copy(tmp_path / "1" / f"policy.{kind}", tmp_path / f"init.{kind}")
    train(tmp_path / "run")
    learned = load_policy(tmp_path / "run" / "policy.json").weights
    first, other = (load_policy(tmp_path / str(k) / "policy.json").weights for k in (0, 1))
    same = [name for name in learned if name != "log_std"]  # only the critic has learned
    assert all(np.array_equal(learned[name], first[name]) for name in same)
    assert not all(np.array_equal(first[name], other[name]) for name in same)
    shutil.rmtree(tmp_path / "run" / "checkpoints")
    for name in ("curve.csv", "policy.json"):
        (tmp_path / "run" / name).unlink()
    (tmp_path / "run" / "start.safetensors").write_bytes(b"damaged")
    with pytest.raises(SettingsError, match="start.safetensors: cannot be read"):
        train(tmp_path / "run")


def test_what_a_checkpoint_could_not_tell_makes_no_run(tmp_path):
    reward = {"calm": (1.0, Effort()), "near": (1.0, Near())}
    with pytest.raises(SettingsError, match=r"reward\.near\.term\.reach: inf cannot be kept with a run; it must be fi"):
        begin(tmp_path / "run", PRESET.but(reward=reward))
    assert not (tmp_path / "run").exists()


def test_policies_of_another_run_are_not_taken_for_its_own(unbroken, tmp_path):
    """They count the same shepherd-steps, whatever was learned."""
    shutil.copytree(unbroken, tmp_path / "run")
    for name in ("policy.json", "best.json"):
        own = load_policy(unbroken / name)
        write_policy(tmp_path / "run" / name, own.spec, {k: v + 1 for k, v in own.weights.items()})
    train(tmp_path / "run")
    assert_same_run(tmp_path / "run", unbroken)


def test_a_folder_holds_one_run(unbroken):
    with pytest.raises(SettingsError, match="holds a run: --resume continues it"):
        begin(unbroken, PRESET)


# --------------------------------------------------------------- checkpoints

ARRAYS = {"a": np.arange(6, dtype=np.float32).reshape(2, 3), "b": np.array(1.5), "c": np.zeros((2, 3)).T}


def test_checkpoints_are_read_as_they_were_written_and_two_are_kept(tmp_path):
    for number in (1, 2, 3, 11):
        checkpoints.save(tmp_path, Checkpoint(number, ARRAYS, {"x": 0.1, "n": number}))
    assert sorted(os.listdir(tmp_path)) == ["checkpoint-000003.safetensors", "checkpoint-000011.safetensors"]
    read = checkpoints.load_latest(tmp_path)
    assert (read.number, read.facts) == (11, {"x": 0.1, "n": 11})
    for name, array in ARRAYS.items():
        np.testing.assert_array_equal(read.arrays[name], array)
        assert read.arrays[name].dtype == array.dtype


def test_a_damaged_checkpoint_gives_way_to_the_one_before(tmp_path):
    first = checkpoints.save(tmp_path, Checkpoint(1, ARRAYS, {}))
    second = checkpoints.save(tmp_path, Checkpoint(2, ARRAYS, {}))
    whole = second.read_bytes()
    for damaged in (b"", whole[:50], whole[:-1], whole[:-1] + b"\x07", b"\x80\x04pickle"):
        second.write_bytes(damaged)
        assert checkpoints.load_latest(tmp_path).number == 1
    first.write_bytes(b"")
    with pytest.raises(CheckpointError, match="checkpoint-000002.safetensors: is not a checkpoint"):
        checkpoints.load_latest(tmp_path)


def test_what_a_checkpoint_tells_beside_its_arrays_is_checked_too(tmp_path):
    path = checkpoints.save(tmp_path, Checkpoint(1, ARRAYS, {"rollouts": 20, "best": {"score": 97.5}}))
    whole = path.read_bytes()
    for right, wrong in ((b"20", b"21"), (b"97.5", b"99.5"), (b"rollouts", b"rollouds")):
        assert whole.count(right) == 1
        path.write_bytes(whole.replace(right, wrong))
        with pytest.raises(CheckpointError, match="is damaged"):
            checkpoints.load(path)


def test_files_that_are_no_checkpoints_are_left_alone(tmp_path):
    assert checkpoints.load_latest(tmp_path) is None
    assert checkpoints.load_latest(tmp_path / "nowhere") is None
    for name in ("checkpoint-000007.safetensors.part", "notes.txt"):
        (tmp_path / name).write_bytes(b"half")
    assert checkpoints.load_latest(tmp_path) is None
    safetensors.numpy.save_file({"a": np.zeros(1)}, tmp_path / "checkpoint-000001.safetensors")
    with pytest.raises(CheckpointError, match="is not a checkpoint"):
        checkpoints.load(tmp_path / "checkpoint-000001.safetensors")


def test_a_checkpoint_that_cannot_be_written_costs_no_other(tmp_path, monkeypatch):
    checkpoints.save(tmp_path, Checkpoint(1, ARRAYS, {}))

    def full(self, content):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(CheckpointError, match="No space left"):
        checkpoints.save(tmp_path, Checkpoint(2, ARRAYS, {}))
    assert os.listdir(tmp_path) == ["checkpoint-000001.safetensors"]
    assert checkpoints.load_latest(tmp_path).number == 1


def test_a_checkpoint_of_what_json_does_not_know_is_refused(tmp_path):
    with pytest.raises(CheckpointError, match="cannot be written .*not JSON compliant"):
        checkpoints.save(tmp_path, Checkpoint(1, ARRAYS, {"x": float("inf")}))
    assert not list(tmp_path.glob("*"))


def test_a_table_goes_on_where_the_checkpoint_was(tmp_path):
    table = Table(tmp_path / "curve.csv", CURVE_COLUMNS, 0)
    for rollout in (1, 2, 3):
        table.add({"rollout": rollout, "episode_reward": float("nan"), "in_goal_end": 1.5})
    with open(tmp_path / "curve.csv", "a") as file:
        file.write("4,12")  # torn
    table = Table(tmp_path / "curve.csv", CURVE_COLUMNS, 2)
    table.add({"rollout": 3})
    rows = rows_of(tmp_path / "curve.csv")
    assert [row["rollout"] for row in rows] == ["1", "2", "3"]
    assert (rows[0]["episode_reward"], rows[0]["in_goal_end"], rows[2]["in_goal_end"]) == ("", "1.5", "")


# ------------------------------------------------------------------ command


def shepherd_phys(*words, cwd):
    command = Path(sys.executable).parent / "shepherd-phys"
    return subprocess.run([str(command), *words], cwd=cwd, capture_output=True, text=True, timeout=300, check=False)


def test_a_run_whose_learning_rate_falls_keeps_its_budget(tmp_path, capsys):
    begin(tmp_path / "run", PRESET.but(ppo=PRESET.ppo.but(last_learning_rate=1e-5)))
    assert train_main(["--resume", "--out", str(tmp_path / "run"), "--budget", "700"]) == 2
    assert "falls over its budget" in capsys.readouterr().err
    assert Preset.from_toml(tmp_path / "run" / "preset.toml").budget == PRESET.budget


def test_a_run_does_not_go_on_by_a_preset_that_was_changed(unbroken, tmp_path, capsys):
    shutil.copytree(unbroken, tmp_path / "run")
    written = tmp_path / "run" / "preset.toml"
    kept, before = load_preset(written), sorted((tmp_path / "run").rglob("*"))
    kept.but(seed=3, ppo=kept.ppo.but(gamma=0.5)).to_toml(written)
    assert train_main(["--resume", "--out", str(tmp_path / "run"), "--budget", "9000"]) == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert f"{written}: changed since the run began" in said
    assert f": ppo.gamma, now 0.5, was {kept.ppo.gamma}; seed, now 3, was {kept.seed}. Undo that" in said
    assert sorted((tmp_path / "run").rglob("*")) == before
    kept.to_toml(written)
    train(tmp_path / "run")
    assert load_preset(written) == kept


@pytest.mark.slow
def test_the_command_trains_resumes_and_evaluates(tmp_path):
    TINY.but(budget=200).to_toml(tmp_path / "tiny.toml")
    first = ("train", "--preset", "tiny.toml", "--reward", "original", "--seed", "1000007", "--workers", "1")
    run = shepherd_phys(*first, cwd=tmp_path)
    assert run.returncode == 0, run.stderr
    folder = Path("runs/tiny-original-1000007")
    assert run.stdout.splitlines()[1:] == [
        str(folder / name) for name in ("best.json", "policy.json", "curve.csv", "validation.csv")
    ]
    assert "validation at" in run.stderr
    run = shepherd_phys(*first, cwd=tmp_path)
    assert run.returncode == 2 and "--resume continues it" in run.stderr
    run = shepherd_phys("train", "--resume", "--out", str(folder), "--budget", "500", "--workers", "1", cwd=tmp_path)
    assert run.returncode == 0, run.stderr
    assert len(rows_of(tmp_path / folder / "curve.csv")) == TINY.but(budget=500).n_rollouts == 6
    run = shepherd_phys("train", "--resume", "--out", str(folder), "--reward", "any", cwd=tmp_path)
    assert run.returncode == 2 and "other settings: reward is 'original' there, 'any' here; --resume" in run.stderr
    command = ("evaluate", "--controllers", str(folder / "best.json"), "--scenario", "small")
    run = shepherd_phys(*command, "--trials", "1", "--workers", "1", cwd=tmp_path)
    assert run.returncode == 0, run.stderr
    (tmp_path / folder / "best.safetensors").write_bytes(b"")
    run = shepherd_phys(*command, cwd=tmp_path)
    assert run.returncode == 2 and len(run.stderr.splitlines()) == 1 and "is damaged" in run.stderr


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--preset", "fats"], "neither a .toml file nor one of"),
        (["--reward", "wold"], "'wold' is not one of"),
        (["--workers", "0"], "workers: 0 is impossible"),
        (["--seed", "-1"], "seed: -1 is impossible"),
        (["--budget", "many"], "--budget"),
        (["--resume"], "--resume needs --out"),
        (["--resume", "--out", "nowhere"], "holds no run to resume"),
        (["--moon"], "--moon"),
        (["--init", "no.json", "--out", "x"], "no.json: cannot be read"),
        (["--init", "moon", "--out", "x"], "'moon' is neither a .json file nor a shipped policy"),
    ],
)
def test_a_mistake_is_one_line(words, said, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert train_main(words) == 2
    error = capsys.readouterr().err
    assert said in error and len(error.splitlines()) == 1
    assert os.listdir(tmp_path) == []


def test_a_mistake_in_a_shell_is_one_line(tmp_path):
    run = shepherd_phys("train", "--reward", "wold", cwd=tmp_path)
    assert run.returncode == 2
    assert run.stderr.startswith("shepherd-phys train: ") and len(run.stderr.splitlines()) == 1
    assert os.listdir(tmp_path) == []
