"""Policy files: written and read, refused when damaged or hostile; policies that act as their network says."""

import hashlib
import itertools
import json
import math
import os
import struct
import subprocess
import sys
from dataclasses import dataclass
from functools import partial

import numpy as np
import pymunk
import pytest
import safetensors.numpy
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from shepherd_phys import mirror
from shepherd_phys.bodies import Disc
from shepherd_phys.controllers import CONTROLLERS, POLICIES, Policy, load_policy
from shepherd_phys.controllers.evaluation import evaluate, trial_seed
from shepherd_phys.controllers.network import Actor, SectorNetwork, input_shape
from shepherd_phys.controllers.policy_files import (
    FIELDS,
    MAX_JSON,
    Acting,
    PolicyError,
    PolicySpec,
    _checksum,
    read_policy,
    write_policy,
)
from shepherd_phys.envs import ShepherdingEnv
from shepherd_phys.lidar import Lidar
from shepherd_phys.observation import observe, turn
from shepherd_phys.scenario import SCENARIOS, Scenario
from shepherd_phys.scripts.points import find_controller, points
from shepherd_phys.settings import Foreign, SettingsError
from shepherd_phys.world import World

LIDAR = Lidar(beams=64, sectors=16, stack=2, frame="goal")
STATE = World(SCENARIOS["small"]).reset(0)
SMALL = SectorNetwork(features=5, hidden=7, latent=6)


def random_weights(network, lidar, seed=0):
    rng = np.random.default_rng(seed)
    return {
        name: (rng.normal(size=shape) / math.sqrt(shape[-1])).astype(np.float32)
        for name, shape in network.shapes(lidar).items()
    }


def spec_of(lidar=LIDAR, network=SMALL, scenario=None, **action):
    scenario = scenario or SCENARIOS["small"]
    return PolicySpec(scenario, lidar, network, Acting(frame=lidar.frame, **action), {"scheme": "wild"}, {"seed": 1})


@pytest.fixture
def policy_path(tmp_path):
    path = tmp_path / "p.json"
    write_policy(path, spec_of(), random_weights(SMALL, LIDAR))
    return path


def by_hand(weights, network, observation):
    """The formulas of `SectorNetwork`, in float64."""
    w = {name: array.astype(np.float64) for name, array in weights.items()}
    columns = observation.shape[1]
    features = []
    for g in range(columns // network.group):
        seen = np.arange(g * network.group - network.overlap, (g + 1) * network.group + network.overlap) % columns
        features.append(np.maximum(w["groups.weight"] @ observation[:, seen].reshape(-1) + w["groups.bias"], 0))
    hidden = np.maximum(w["hidden.weight"] @ np.concatenate(features) + w["hidden.bias"], 0)
    latent = np.tanh(w["latent.weight"] @ hidden + w["latent.bias"])
    return w["action.weight"] @ latent + w["action.bias"]


@pytest.mark.parametrize("overlap", [0, 1, 4, 6])
@pytest.mark.parametrize("density", [0.0, 0.1, 1.0])
def test_the_network_is_its_formulas(overlap, density):
    network = SMALL.but(overlap=overlap)
    weights = random_weights(network, LIDAR)
    rng = np.random.default_rng(1)
    observation = rng.random((4, 6, 16), dtype=np.float32) * (rng.random((4, 6, 16)) < density)
    wanted = [by_hand(weights, network, one) for one in observation]
    assert Actor(network, LIDAR, weights)(observation) == pytest.approx(np.array(wanted), abs=1e-5)


def test_a_turn_by_a_group_only_permutes_the_groups():
    """All groups share one layer and beams wrap around."""
    network = SectorNetwork(group=4, overlap=2, features=3, hidden=12, latent=2)
    weights = random_weights(network, LIDAR)
    weights["hidden.weight"] = np.eye(12, dtype=np.float32)
    turned = {**weights, "hidden.weight": np.roll(np.eye(12, dtype=np.float32), 3, axis=1)}
    turned["hidden.bias"] = weights["hidden.bias"]
    observation = np.random.default_rng(2).random((1, 6, 16), dtype=np.float32)
    rolled = np.roll(observation, 4, axis=2)
    wanted = Actor(network, LIDAR, turned)(rolled)
    assert Actor(network, LIDAR, weights)(observation) == pytest.approx(wanted, abs=1e-6)


def test_what_is_written_is_read(policy_path):
    spec, weights, checksum = read_policy(policy_path)
    assert spec == spec_of()
    for name, array in random_weights(SMALL, LIDAR).items():
        np.testing.assert_array_equal(weights[name], array)
    assert checksum == write_policy(policy_path.with_name("other.json"), spec_of(), weights)
    assert checksum != write_policy(policy_path, spec_of(interval=2), weights)
    assert checksum != write_policy(policy_path, spec_of(), random_weights(SMALL, LIDAR, seed=1))
    assert sorted(os.listdir(policy_path.parent)) == ["other.json", "other.safetensors", "p.json", "p.safetensors"]


def test_it_acts_by_its_network_in_the_frame_of_the_goal(policy_path):
    policy = load_policy(policy_path)
    env = ShepherdingEnv("small", rewards={}, lidar=policy.lidar)
    reference = ShepherdingEnv("small", rewards={}, lidar=LIDAR)  # rolls by itself
    observation, _ = env.reset(seed=3)
    seen, _ = reference.reset(seed=3)
    policy.reset(env.user_rng)
    for _ in range(20):
        action = policy.act(observation, env.state)
        raw = np.clip([by_hand(policy.weights, SMALL, one) for one in seen], -1, 1)
        raw /= np.maximum(np.linalg.norm(raw, axis=1), 1)[:, None]
        assert action == pytest.approx(turn(raw, reference.beam_offset, 64), abs=1e-5)
        assert action.dtype == np.float64
        observation, *_ = env.step(action)
        seen, *_ = reference.step(action)


@hypothesis_settings(deadline=None, max_examples=30)
@given(st.integers(0, 2**32 - 1))
def test_actions_lie_in_the_unit_disc(seed):
    lidar = Lidar(beams=16, stack=1)
    weights = random_weights(SMALL, lidar, seed)
    weights["action.weight"] *= 10
    policy = Policy(spec_of(lidar), weights)
    observation = np.random.default_rng(seed).random((5, 3, 16), dtype=np.float32)
    action = policy.act(observation, STATE)
    assert (np.hypot(*action.T) <= 1 + 1e-12).all()
    raw = np.clip(Actor(SMALL, lidar, weights)(observation), -1, 1)
    for a, b in zip(action, raw, strict=True):
        assert abs(a[0] * b[1] - a[1] * b[0]) < 1e-6 and a @ b >= 0  # the same direction


def test_a_decision_is_held_for_its_interval():
    lidar = Lidar(beams=16, stack=1)
    policy = Policy(spec_of(lidar, interval=3), random_weights(SMALL, lidar))
    env = ShepherdingEnv("small", rewards={}, lidar=policy.lidar)
    observation, _ = env.reset(seed=0)
    policy.reset(env.user_rng)
    actions = []
    for _ in range(6):
        actions.append(policy.act(observation, env.state))
        observation, *_ = env.step([[1.0, 0.0], [0.0, 1.0]])
    same = [np.array_equal(a, b) for a, b in itertools.pairwise(actions)]
    assert same == [True, True, False, True, True]


@pytest.mark.parametrize("overlap", [0, 3])
def test_who_sees_in_a_mirror_acts_as_if_shown_one(overlap):
    network = SMALL.but(overlap=overlap)
    weights = random_weights(network, LIDAR)
    rng = np.random.default_rng(2)
    rows, columns = input_shape(LIDAR)
    seen = rng.random((5, rows, columns), dtype=np.float32) * (rng.random((5, rows, columns)) < 0.3)
    who = np.array([True, False, True, False, True])
    actor = Actor(network, LIDAR, weights)
    np.testing.assert_array_equal(actor(seen, who), actor(mirror.seen(seen, who)))
    assert not np.allclose(actor(seen, who)[0], actor(seen)[0])
    np.testing.assert_array_equal(actor(seen, who)[1], actor(seen)[1])


def test_chance_is_drawn_anew_after_its_time_in_proportion_to_the_deviation_and_from_the_seed():
    lidar = Lidar(beams=16, stack=1)
    weights = random_weights(SMALL, lidar)
    weights["log_std"][:] = (-2.0, -1.0)
    for name in ("action.weight", "action.bias"):
        weights[name] *= 0.1
    seen = np.random.default_rng(1).random((5, 3, 16), dtype=np.float32)
    actor = Actor(SMALL, lidar, weights)
    mean, deviation = actor(seen), actor.deviation

    def acts(noise, seed, n_steps=7):
        policy = Policy(spec_of(lidar, noise=noise, noise_steps=3), weights)
        policy.reset(np.random.default_rng(seed))
        return np.array([policy.act(seen, STATE.but(step=k)) for k in range(n_steps)])

    added = (acts(0.5, 7) - mean) / deviation
    same = [np.allclose(a, b) for a, b in itertools.pairwise(added)]
    assert same == [True, True, False, True, True, False]
    drawn = 0.5 * np.random.default_rng(7).standard_normal((3, 5, 2))
    assert added[[0, 3, 6]] == pytest.approx(drawn, abs=1e-4)
    np.testing.assert_array_equal(acts(0.5, 7), acts(0.5, 7))
    np.testing.assert_array_equal(acts(0.0, 7), acts(0.0, 8))
    assert (acts(0.0, 7) == pytest.approx(np.tile(mean, (7, 1, 1)))) and not np.array_equal(acts(0.5, 7), acts(0.5, 8))


def test_chance_rest_interval_and_the_goals_frame_go_together():
    weights = random_weights(SMALL, LIDAR)
    weights["log_std"][:] = (-1.0, -0.5)
    for name in ("action.weight", "action.bias"):
        weights[name] *= 0.4
    policy = Policy(spec_of(noise=0.5, noise_steps=3, rest=0.4, interval=2), weights)
    env = ShepherdingEnv("small", rewards={}, lidar=policy.lidar)
    reference = ShepherdingEnv("small", rewards={}, lidar=LIDAR)  # rolls by itself
    observation, _ = env.reset(seed=3)
    seen, _ = reference.reset(seed=3)
    policy.reset(np.random.default_rng(7))
    rng, actor, rests = np.random.default_rng(7), Actor(SMALL, LIDAR, weights), []
    for k in range(18):
        if k % 3 == 0:
            chance = 0.5 * rng.standard_normal((len(seen), 2))
        if k % 2 == 0:
            mean, deviation = actor(seen), actor.deviation
            raw = np.clip(mean + chance * deviation, -1, 1)
            speed = np.linalg.norm(raw, axis=1, keepdims=True)
            wanted = turn(np.where(speed < 0.4, 0.0, raw / np.maximum(speed, 1)), reference.beam_offset, 64)
            rests += list(speed < 0.4)
        action = policy.act(observation, env.state)
        assert action == pytest.approx(wanted, abs=1e-5)
        observation, *_ = env.step(action)
        seen, *_ = reference.step(action)
    assert any(rests) and not all(rests)


def test_less_than_the_least_speed_is_standing_still():
    lidar = Lidar(beams=16, stack=1)
    weights = random_weights(SMALL, lidar, 3)
    weights["action.weight"] *= 0.01
    weights["action.bias"] *= 0.01
    observation = np.random.default_rng(1).random((40, 3, 16), dtype=np.float32)
    walks = Policy(spec_of(lidar), weights).act(observation, STATE)
    speed = np.hypot(*walks.T)
    rest = float(np.median(speed))
    rests = Policy(spec_of(lidar, rest=rest), weights).act(observation, STATE)
    np.testing.assert_array_equal(rests, np.where((speed < rest)[:, None], 0.0, walks))
    assert 0 < np.count_nonzero(rests[:, 0] == 0.0) < 40


def test_who_has_the_nearest_sheep_on_that_side_sees_the_world_in_a_mirror():
    lidar = Lidar(beams=64, stack=2, frame="goal")
    weights = random_weights(SMALL, lidar)
    seen = np.random.default_rng(0).random((4, 6, 64), dtype=np.float32) * 0.5
    seen[:, 2::3] = 0.0
    seen[:, 2::3, 0] = 0.5  # the goal, straight ahead
    for shepherd, beam in enumerate((9, 55, 0, 32)):  # nearest sheep: left, right, ahead, behind
        seen[shepherd, 3, beam] = 0.9
    seen[:, 0, 20] = 0.99  # what was nearest a step ago does not count
    mirrored = seen[:, :, -np.arange(64)]

    def acts(mirror, *observations):
        policy = Policy(spec_of(lidar, mirror=mirror), weights)
        return [policy.act(observation, STATE) for observation in observations]

    (plain,), (other,) = acts("never", seen), acts("never", mirrored)
    (left,), (right,) = acts("left", seen), acts("right", seen)
    np.testing.assert_allclose(left, [other[0] * (1, -1), plain[1], plain[2], plain[3]], atol=1e-6)
    np.testing.assert_allclose(right, [plain[0], other[1] * (1, -1), plain[2], plain[3]], atol=1e-6)
    assert not np.allclose(left[0], plain[0]) and not np.allclose(right[1], plain[1])
    # it stays so for the episode, wherever the nearest sheep is later
    _, later = acts("left", seen, mirrored)
    np.testing.assert_allclose(later, [plain[0] * (1, -1), *other[1:]], atol=1e-6)
    # and the next episode begins without it
    policy = Policy(spec_of(lidar, mirror="left"), weights)
    policy.act(mirrored, STATE)
    policy.reset(np.random.default_rng(0))
    np.testing.assert_allclose(policy.act(seen, STATE), left, atol=1e-6)


@pytest.mark.parametrize("lidar", [Lidar(), Lidar(frame="goal", channels=("goal",))])
def test_a_mirror_needs_the_goal_ahead_and_sheep_to_see(lidar):
    with pytest.raises(PolicyError, match=r"action.mirror: needs the frame 'goal', the channel of sheep"):
        spec_of(lidar, mirror="left")


def test_each_shepherd_acts_alone():
    """Whoever else is in the team: the same observation, the same action."""
    policy = Policy(spec_of(), random_weights(SMALL, LIDAR))
    observation = np.random.default_rng(0).random((3, 6, 64), dtype=np.float32)
    together = policy.act(observation, STATE)
    for k in range(3):
        policy.reset(np.random.default_rng(0))
        assert policy.act(observation[k : k + 1], STATE) == pytest.approx(together[k : k + 1], abs=1e-6)


def test_evaluation_names_it_and_identifies_it_by_its_checksum(policy_path):
    policy = load_policy(policy_path)
    rows = evaluate(policy, partial(ShepherdingEnv, SCENARIOS["small"].but(n_steps=5)), [20_000])
    again = evaluate(policy, partial(ShepherdingEnv, SCENARIOS["small"].but(n_steps=5)), [20_000])
    assert rows == again
    assert rows[0]["controller"] == "p"
    assert policy.to_dict() == {"policy": read_policy(policy_path)[2]}


def test_it_runs_without_torch(policy_path):
    code = f"""
import sys
sys.modules["torch"] = sys.modules["stable_baselines3"] = None  # nobody can import them from here on
from functools import partial
from shepherd_phys.controllers import load_policy
from shepherd_phys.controllers.evaluation import evaluate
from shepherd_phys.envs import ShepherdingEnv
from shepherd_phys.scenario import SCENARIOS
print(len(evaluate(load_policy({str(policy_path)!r}), partial(ShepherdingEnv, SCENARIOS["small"].but(n_steps=3)), [1])))
"""
    run = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, check=False)
    assert (run.returncode, run.stdout) == (0, "1\n"), run.stderr


# ------------------------------------------------------- a user's own classes


@dataclass(frozen=True)
class Tank:
    max_speed: float = 1.0

    def build(self):
        body = pymunk.Body(20.0, math.inf)
        return body, [pymunk.Circle(body, 0.6)]

    def follow(self, pose, wanted, dt):
        return wanted, 0.0


def test_a_class_of_somebodys_own_stays_text_until_it_is_handed_over(tmp_path, monkeypatch):
    scenario = SCENARIOS["small"].but(shepherds=(Tank(), Disc()), n_steps=3)
    path = tmp_path / "p.json"
    write_policy(path, spec_of(scenario=scenario), random_weights(SMALL, LIDAR))
    table = json.loads(path.read_text())
    table["scenario"]["shepherds"][0]["kind"] = "a_module_that_is_not_there:Tank"
    resealed(path, table)
    (tmp_path / "a_module_that_is_not_there.py").write_text("raise SystemExit('imported')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    policy = load_policy(path)
    assert isinstance(policy.spec.scenario.shepherds[0], Foreign)
    assert len(evaluate(policy, partial(ShepherdingEnv, SCENARIOS["small"].but(n_steps=3)), [1])) == 1  # not needed
    with pytest.raises(SettingsError, match="a_module_that_is_not_there:Tank.*was not handed over"):
        evaluate(policy, partial(ShepherdingEnv, policy.spec.scenario), [1])
    assert "a_module_that_is_not_there" not in sys.modules
    write_policy(path, spec_of(scenario=scenario), random_weights(SMALL, LIDAR))
    policy = load_policy(path, classes=[Tank])
    assert len(evaluate(policy, partial(ShepherdingEnv, policy.spec.scenario), [1])) == 1


# ------------------------------------------------------- damaged and hostile


def resealed(path, table, blob=None):
    """Write a pair whose checksums are right whatever it says: what a hostile author would do."""
    if blob is not None:
        path.with_suffix(".safetensors").write_bytes(blob)
        table["weights_sha256"] = hashlib.sha256(blob).hexdigest()
    table.pop("checksum", None)
    table["checksum"] = _checksum(table)
    path.write_text(json.dumps(table))


def header(entries, data=b""):
    """A safetensors file by hand."""
    text = json.dumps(entries).encode()
    return struct.pack("<Q", len(text)) + text + data


def weights_with(**changes):
    weights = random_weights(SMALL, LIDAR)
    for name, change in changes.items():
        name = name.replace("_", ".")
        weights[name] = change(weights[name])
    return safetensors.numpy.save({k: np.ascontiguousarray(v) for k, v in weights.items()})


def poisoned(value):
    def change(array):
        array = array.copy()
        array.flat[3] = value
        return array

    return change


def first_entry(**changes):
    """The header with one entry changed and the data as they are."""
    blob = weights_with()
    (size,) = struct.unpack("<Q", blob[:8])
    entries = json.loads(blob[8 : 8 + size])
    entries["hidden.bias"] |= changes
    return header(entries, blob[8 + size :])


HOSTILE_WEIGHTS = {
    "a NaN": weights_with(hidden_weight=poisoned(np.nan)),
    "an infinity": weights_with(action_bias=lambda a: np.full_like(a, np.inf)),
    "negative infinity": weights_with(groups_bias=poisoned(-np.inf)),
    "transposed": weights_with(hidden_weight=lambda a: a.T),
    "flat": weights_with(hidden_weight=lambda a: a.reshape(-1)),
    "a row too many": weights_with(hidden_weight=lambda a: np.vstack([a, a[:1]])),
    "no rows": weights_with(hidden_weight=lambda a: a[:0]),
    "float64": weights_with(hidden_bias=lambda a: a.astype(np.float64)),
    "float16": weights_with(hidden_bias=lambda a: a.astype(np.float16)),
    "integers": weights_with(hidden_bias=lambda a: a.astype(np.int32)),
    "a dtype that is none": first_entry(dtype="OBJECT"),
    "a dtype that numpy lacks": first_entry(dtype="BF16"),
    "a dtype that is a number": first_entry(dtype=7),
    "a shape beyond the data": first_entry(shape=[1 << 40]),
    "a negative shape": first_entry(shape=[-7]),
    "offsets beyond the end": first_entry(data_offsets=[0, 1 << 50]),
    "offsets that run backwards": first_entry(data_offsets=[8, 4]),
    "an entry that is a list": header({"hidden.bias": []}),
    "one weight more": safetensors.numpy.save({**random_weights(SMALL, LIDAR), "../x": np.zeros(1, np.float32)}),
    "one weight less": safetensors.numpy.save(
        {k: v for k, v in random_weights(SMALL, LIDAR).items() if k != "log_std"}
    ),
    "no weights": safetensors.numpy.save({}),
    "empty": b"",
    "seven bytes": b"1234567",
    "a header as long as memory": struct.pack("<Q", 1 << 62) + b"{}",
    "a header that is no JSON": struct.pack("<Q", 4) + b"\x80\x04]q",
    "a deep header": struct.pack("<Q", 20_000) + b"[" * 20_000,
    "a pickle": b"\x80\x04cos\nsystem\n(S'touch pwned'\ntR.",
    "larger than its network": weights_with() + b"\0" * (1 << 17),
    "trailing bytes": weights_with() + b"\0\0\0\0",
}


@pytest.mark.parametrize("name", HOSTILE_WEIGHTS)
def test_hostile_weights_are_one_error(name, policy_path):
    resealed(policy_path, json.loads(policy_path.read_text()), HOSTILE_WEIGHTS[name])
    refused(policy_path)


def nested(depth):
    return json.loads("[" * depth + "]" * depth)


HOSTILE_FIELDS = {
    "no format": {"format": None},
    "another format": {"format": "pickle"},
    "a later version": {"format_version": 2},
    "a version of text": {"format_version": "1"},
    "an unknown field": {"run": "os.system('true')"},
    "a field with the weights' path": {"weights": "../../etc/passwd"},
    "a checksum that is a list": {"weights_sha256": ["0"]},
    "a scenario that is text": {"scenario": "paper"},
    "an impossible scenario": {"scenario": {"n_sheep": -1}},
    "an unknown field of the scenario": {"scenario": {"__class__": "os"}},
    "an unknown body": {"scenario": {"sheep": {"kind": "os.system"}}},
    "a body that is a list": {"scenario": {"sheep": [1]}},
    "a body with a strange argument": {"scenario": {"sheep": {"kind": "Disc", "radius": "x" * 1000}}},
    "terminal escapes": {"scenario": {"sheep": {"kind": "\x1b[2J\x07" * 50}}},
    "lidar missing": {"lidar": None},
    "an unknown field of the lidar": {"lidar": {**LIDAR.to_dict(), "path": "/"}},
    "frames without end": {"lidar": {**LIDAR.to_dict(), "stack_stride": 1_000_000}},
    "another layout": {"lidar": {**LIDAR.to_dict(), "layout": "paper"}},
    "a lidar of another size": {"lidar": {**LIDAR.to_dict(), "sectors": 32}},
    "a stack of a million": {"lidar": {**LIDAR.to_dict(), "stack": 1_000_000}},
    "no network": {"network": {}},
    "a network by a class of one's own": {"network": {"kind": "os:system"}},
    "an unknown network": {"network": {"kind": "Pickled"}},
    "huge layers": {"network": {"kind": "SectorNetwork", "hidden": 10**12}},
    "large layers": {"network": {"kind": "SectorNetwork", "features": 4096, "hidden": 4096, "latent": 4096}},
    "a group that does not divide": {"network": {"kind": "SectorNetwork", "group": 3}},
    "actions that scatter by what is seen": {"network": {"kind": "SectorNetwork", "scatter": True}},
    "no group": {"network": {"kind": "SectorNetwork", "group": 0}},
    "more overlap than columns": {"network": {"kind": "SectorNetwork", "overlap": 60}},
    "another frame": {"action": {"frame": "world"}},
    "a frame that is none": {"action": {"frame": "moon"}},
    "an interval of nothing": {"action": {"frame": "goal", "interval": 0}},
    "never moving": {"action": {"frame": "goal", "rest": 1.0}},
    "holding as nobody can": {"action": {"frame": "goal", "hold": {"ring": -1.0}}},
    "holding otherwise": {"action": {"frame": "goal", "hold": {"circle": 1.0}}},
    "holding nothing": {"action": {"frame": "goal", "hold": 3}},
    "wandering for good": {"action": {"frame": "goal", "wander": {"longest": 10**9}}},
    "rewards that are a list": {"rewards": []},
    "training that is text": {"training": "yes"},
}


@pytest.mark.parametrize("name", HOSTILE_FIELDS)
def test_hostile_fields_are_one_error(name, policy_path):
    table = json.loads(policy_path.read_text())
    resealed(policy_path, {**table, **HOSTILE_FIELDS[name]})
    refused(policy_path)


@pytest.mark.parametrize("name", FIELDS)
def test_a_missing_field_is_one_error(name, policy_path):
    table = json.loads(policy_path.read_text())
    del table[name]
    policy_path.write_text(json.dumps(table))
    refused(policy_path)


BAD_TEXTS = {
    "empty": b"",
    "not UTF-8": b'{"format": "\xff\xfe"}',
    "not JSON": b"import os",
    "a list": b"[]",
    "a number": b"1",
    "deep": b"[" * 200_000,
    "deep and closed": b'{"format":' + b"[" * 100_000 + b"]" * 100_000 + b"}",
    "a NaN": b'{"format": NaN}',
    "an infinity": b'{"format": 1e999}',
    "a number of a million digits": b'{"format": ' + b"9" * 1_000_000 + b"}",
    "a field twice": b'{"format": 1, "format": 2}',
    "too large": b'"' + b"x" * MAX_JSON + b'"',
}


def test_nesting_of_any_depth_is_one_error(policy_path):
    """There are depths at which a table can be read and not be written."""
    text = policy_path.read_text()
    assert '"seed": 1' in text
    for depth in (*range(100, 1000, 50), 100_000):
        policy_path.write_text(text.replace('"seed": 1', f'"seed": {"[" * depth}{"]" * depth}'))
        refused(policy_path)


@pytest.mark.parametrize("name", BAD_TEXTS)
def test_bad_json_is_one_error(name, policy_path):
    policy_path.write_bytes(BAD_TEXTS[name])
    refused(policy_path)


@pytest.mark.parametrize("part", ["p.json", "p.safetensors"])
def test_any_cut_and_any_changed_byte_is_an_error(part, policy_path):
    path = policy_path.with_name(part)
    whole = path.read_bytes()
    rng = np.random.default_rng(0)
    for length in rng.integers(0, len(whole) - 1, 20):  # without the newline at the end it is whole
        path.write_bytes(whole[:length])
        refused(policy_path)
    for at in rng.integers(0, len(whole), 40):
        changed = bytearray(whole)
        changed[at] ^= 1 << int(rng.integers(8))
        try:
            same = json.loads(changed) == json.loads(whole)  # white space may change
        except ValueError:
            same = False
        path.write_bytes(changed)
        if not same:
            refused(policy_path)


def test_files_that_are_none(policy_path, tmp_path):
    weights = policy_path.with_suffix(".safetensors")
    kept = weights.read_bytes()
    for path in (policy_path, weights):
        whole = path.read_bytes()
        path.unlink()
        refused(policy_path)
        path.mkdir()
        refused(policy_path)
        path.rmdir()
        for target in ("/dev/zero", path.name, "nowhere"):
            path.symlink_to(target)
            refused(policy_path)
            path.unlink()
        os.mkfifo(path)  # would block for ever
        refused(policy_path)
        path.unlink()
        path.write_bytes(whole)
    weights.rename(tmp_path / "elsewhere")
    weights.symlink_to(tmp_path / "elsewhere")  # a link to data is as good as data
    assert load_policy(policy_path).checksum
    assert (tmp_path / "elsewhere").read_bytes() == kept
    for name in ("p", "p.safetensors", "p.zip", "", ".", "..", "/", "\0.json", "x" * 5000 + ".json"):
        with pytest.raises(PolicyError):
            load_policy(tmp_path / name)


def test_the_other_policys_weights_are_refused(policy_path, tmp_path):
    write_policy(tmp_path / "q.json", spec_of(), random_weights(SMALL, LIDAR, seed=5))
    (tmp_path / "q.safetensors").replace(policy_path.with_suffix(".safetensors"))
    with pytest.raises(PolicyError, match="checksums differ"):
        load_policy(policy_path)


def test_what_cannot_be_read_is_not_written(tmp_path):
    weights = random_weights(SMALL, LIDAR)
    bad = {
        "NaN": {**weights, "hidden.bias": np.full(7, np.nan, np.float32)},
        "float64": {**weights, "hidden.bias": np.zeros(7)},
        "too few": {"log_std": weights["log_std"]},
        "too many": {**weights, "critic": np.zeros(3, np.float32)},
    }
    for wrong in bad.values():
        with pytest.raises(PolicyError):
            write_policy(tmp_path / "p.json", spec_of(), wrong)
    for training, message in (
        ({"loss": math.nan}, "plain, finite data"),
        ({"policy": object()}, "plain, finite data"),
        ({"diary": "x" * MAX_JSON}, "at most 1048576 are read"),
    ):
        spec = PolicySpec(SCENARIOS["small"], LIDAR, SMALL, Acting(frame="goal"), {}, training)
        with pytest.raises(PolicyError, match=message):
            write_policy(tmp_path / "p.json", spec, weights)
    huge = SectorNetwork(hidden=4096, latent=4096)
    with pytest.raises(PolicyError, match="bytes of weights; at most 67108864 are read"):
        write_policy(tmp_path / "p.json", spec_of(network=huge), random_weights(huge, LIDAR))
    with pytest.raises(PolicyError, match="cannot be written"):
        write_policy(tmp_path / "no" / "p.json", spec_of(), weights)
    with pytest.raises(PolicyError, match="named by its .json file"):
        write_policy(tmp_path / "p", spec_of(), weights)
    with pytest.raises(PolicyError, match="frame"):
        PolicySpec(Scenario(), LIDAR, SMALL, Acting(frame="world"))
    assert os.listdir(tmp_path) == []


def refused(path):
    """One line that names the file; nothing ran, nothing was left behind."""
    before = sorted(os.listdir(path.parent))
    with pytest.raises(PolicyError) as caught:
        load_policy(path)
    message = str(caught.value)
    assert message.isprintable() and len(message) < 800, message
    assert "p.json" in message or "p.safetensors" in message
    assert sorted(os.listdir(path.parent)) == before


@pytest.mark.parametrize("network", [SMALL.but(hidden=6), SMALL.but(latent=9), SMALL.but(features=4)])
def test_weights_of_another_network_are_refused(network):
    with pytest.raises(PolicyError, match=r"must be float32 \("):
        Policy(spec_of(network=network), random_weights(SMALL, LIDAR))


@pytest.mark.parametrize("n", [2, 4])
def test_a_team_of_another_size_needs_a_reset(n):
    policy = Policy(spec_of(noise=0.3), random_weights(SMALL, LIDAR))
    world = World(SCENARIOS["small"])
    state = world.reset(1)
    policy.act(np.zeros(policy.lidar.observation_shape(3), np.float32), state)
    other = np.zeros(policy.lidar.observation_shape(n), np.float32)
    with pytest.raises(ValueError, match=f"is of {n} shepherds, in an episode that began with 3; call reset first"):
        policy.act(other, state)
    policy.reset(np.random.default_rng(0))
    assert policy.act(other, state).shape == (n, 2)


def test_observing_needs_an_offset_for_each_shepherd():
    with pytest.raises(ValueError, match=r"offset: needs the shape \(6,\), has \(3,\)"):
        observe(np.zeros((6, 2, 3, 64), np.float32), np.zeros(3, np.int64), LIDAR)


def test_observations_of_another_shape_are_refused():
    with pytest.raises(ValueError, match=r"needs the shape \(P, 6, 16\)"):
        Actor(SMALL, LIDAR, random_weights(SMALL, LIDAR))(np.zeros((2, 6, 64), np.float32))


def test_observe_leaves_the_frames_alone():
    stack = np.random.default_rng(0).random((2, 2, 3, 64), dtype=np.float32)
    kept = stack.copy()
    for lidar in (LIDAR, Lidar(beams=64, stack=2), Lidar(beams=64, stack=2, layout="paper")):
        seen, _ = observe(stack, np.zeros(2, np.int64), lidar)
        seen[:] = 7.0
        np.testing.assert_array_equal(stack, kept)


def test_the_command_line_takes_a_policy_file_and_knows_it_by_its_checksum(policy_path, tmp_path):
    assert find_controller(str(policy_path)).checksum == read_policy(policy_path)[2]
    with pytest.raises(SettingsError, match=r"a policy's \.json file"):
        find_controller("p")
    copy = tmp_path / "a:copy.json"
    write_policy(copy, *read_policy(policy_path)[:2])
    write_policy(tmp_path / "q.json", spec_of(), random_weights(SMALL, LIDAR, seed=1))
    hashes = [
        points(controllers=[str(path)], scenario="small")[0].settings_hash()
        for path in (policy_path, copy, tmp_path / "q.json")
    ]
    assert hashes[0] == hashes[1] != hashes[2]


def texts(data):
    """All texts in plain data."""
    if isinstance(data, dict | list):
        return [text for part in (data.values() if isinstance(data, dict) else data) for text in texts(part)]
    return [data] if isinstance(data, str) else []


def test_every_shipped_policy_is_a_controller_and_whole():
    assert set(POLICIES) == {"any", "collie", "collie-obstacles", "original", "wild"}
    for name in POLICIES:
        assert CONTROLLERS[name] is POLICIES[name]
        policy = POLICIES[name]()
        assert policy.checksum
        said = texts(policy.spec.training)
        assert said and not [text for text in said if "/" in text]  # no path of whoever trained it


@pytest.mark.parametrize(
    ("name", "scenario"), [("wild", "paper"), ("collie", "paper"), ("collie-obstacles", "scattered")]
)
def test_a_shipped_policy_brings_the_sheep_home(name, scenario):
    """A whole episode on a validation seed."""
    (row,) = evaluate(POLICIES[name](), partial(ShepherdingEnv, SCENARIOS[scenario]), [trial_seed(10_000, 0)])
    assert row["in_goal_end"] >= 95.0


def test_a_policy_that_sees_no_sheep_acts():
    lidar = Lidar(beams=16, channels=("shepherds", "goal"), stack=1)
    policy = Policy(spec_of(lidar), random_weights(SMALL, lidar))
    assert policy.act(np.zeros((2, 2, 16), np.float32), STATE).shape == (2, 2)


def test_without_chance_how_much_of_it_was_learned_does_not_matter():
    lidar = Lidar(beams=16, stack=1)
    weights = random_weights(SMALL, lidar)
    seen = np.random.default_rng(1).random((5, 3, 16), dtype=np.float32)
    usual = Policy(spec_of(lidar), weights).act(seen, STATE)
    weights["log_std"][:] = 1000.0
    with np.errstate(over="ignore"):
        np.testing.assert_array_equal(Policy(spec_of(lidar), weights).act(seen, STATE), usual)
