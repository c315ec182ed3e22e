"""Replays: what was, bit for bit; files that are none; an episode played again."""

import json
import zipfile
from dataclasses import dataclass

import numpy as np
import pymunk
import pytest

from shepherd_phys.bodies import BODIES, Disc
from shepherd_phys.controllers import StrombomTeam
from shepherd_phys.controllers.evaluation import run_episode
from shepherd_phys.controllers.recording import record, recorded
from shepherd_phys.envs import ShepherdingEnv
from shepherd_phys.flock import Reynolds, Strombom
from shepherd_phys.imperfections import Imperfections
from shepherd_phys.obstacles import Box, Fence, Outline, Pillar, Polygon, Wall, outlines
from shepherd_phys.replay import Recorder, Replay, ReplayError, difference
from shepherd_phys.replay_file import MAX_BYTES, checksum, load_replay, save_replay
from shepherd_phys.scenario import SCENARIOS, Scenario
from shepherd_phys.settings import SettingsError

SMALL = Scenario(n_sheep=8, n_flocks=2, shepherds=2, n_steps=25, flock=Strombom(n_neighbours=4))


class Pacing:
    """A controller that needs nothing, whose parameters are told."""

    lidar = None

    def reset(self, rng):
        self.rng = rng

    def act(self, observation, state):
        return self.rng.uniform(-1.2, 1.2, (state.n_shepherds, 2))

    def to_dict(self):
        return {"pace": 1.2}


@dataclass(frozen=True)
class Rock:
    size: float = 1.5

    def shapes(self, body):
        corners = [(8.0, 8.0), (8.0 + self.size, 8.0), (8.0, 8.0 + self.size)]
        return [pymunk.Circle(body, 0.7, (-9.0, 3.0)), pymunk.Poly(body, corners, radius=0.1)]


@dataclass(frozen=True)
class Heavy:
    radius: float = 0.3
    max_speed: float = 1.1

    def build(self):
        body = pymunk.Body(9.0, float("inf"))
        return body, [pymunk.Circle(body, self.radius)]

    def follow(self, pose, wanted, dt):
        return wanted * 0.9, 0.0


@dataclass(frozen=True)
class Drift:
    pace: float = 0.4

    def velocities(self, state, rng):
        return rng.normal(0.0, self.pace, (state.n_sheep, 2))


OWN = (Rock, Heavy, Drift)
SOLID = (
    Pillar(center=(6.0, -7.0)),
    Wall(start=(-12.0, -12.0), end=(-8.0, -12.0)),
    Box(center=(-5.0, 14.0), size=(2.0, 1.0), angle=0.4),
    Polygon(vertices=((14.0, 0.0), (16.0, 0.0), (15.0, 2.0))),
    Fence(start=(20.0, -5.0), end=(20.0, 5.0), gap=2.0),
)
CASES = {
    "open": SMALL,
    "one_sheep": SMALL.but(n_sheep=1, n_flocks=1),
    "no_shepherd": SMALL.but(shepherds=0),
    "obstacles": SMALL.but(obstacles=SOLID),
    "layout": SCENARIOS["scattered"].but(n_sheep=8, shepherds=2, n_steps=25),
    "fence": SCENARIOS["fence"].but(n_sheep=8, shepherds=2, n_steps=25),
    "bodies": SMALL.but(shepherds=tuple(cls() for cls in BODIES.values()), sheep=(Disc(radius=0.15), Disc(radius=0.2))),
    "reynolds": SMALL.but(flock=Reynolds()),
    "imperfect": SMALL.but(imperfections=Imperfections(action_noise=0.2)),
    "own": SMALL.but(obstacles=(Rock(),), shepherds=(Heavy(), Disc()), flock=Drift()),
    "ends_early": SMALL.but(terminate_on_success=True, flock_distance=(0.0, 0.0), n_steps=40),
}


def rewritten(source, target, change_header=None, arrays=None, rename=None, resign=True):
    """A copy of a file with a change, its checksum made right again."""
    with zipfile.ZipFile(source) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    header = json.loads(members["header.json"])
    loaded = dict(np.load(source))
    for name, change in (arrays or {}).items():
        loaded[name] = change(loaded[name].copy())
    if change_header:
        change_header(header)
    if resign:
        names = [name.removesuffix(".npy") for name in members if name.endswith(".npy")]
        header["checksum"] = checksum(header, {name: loaded[name] for name in names})
    members["header.json"] = json.dumps(header).encode()
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            new_name = (rename or {}).get(name, name)
            if new_name is None:
                continue
            if name.removesuffix(".npy") in (arrays or {}):
                with archive.open(new_name, "w") as file:
                    np.lib.format.write_array(file, loaded[name.removesuffix(".npy")], version=(1, 0))
            else:
                archive.writestr(new_name, content)
    return target


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("replay") / "episode.npz"
    save_replay(record(Pacing(), ShepherdingEnv(SMALL), 7), path)
    return path


@pytest.mark.parametrize("scenario", CASES.values(), ids=CASES)
def test_every_state_comes_back_bit_for_bit_and_is_played_again(scenario, tmp_path):
    env = ShepherdingEnv(scenario)
    recorder = Recorder(env)
    seen = []

    class Watching(Pacing):
        def act(self, observation, state):
            seen.append(state)
            return super().act(observation, state)

    row = run_episode(Watching(), recorder, 3)
    replay = recorder.replay("me", {"pace": 1.2}, "here")
    seen.append(env.state)
    save_replay(replay, tmp_path / "a.npz")
    loaded = load_replay(tmp_path / "a.npz", classes=OWN)
    assert len(loaded) == len(seen) == row["steps"] + 1
    for kept, was in zip(loaded, seen, strict=True):
        assert difference(kept, was) is None
        assert not kept.sheep_pos.flags.writeable
    assert (loaded.controller, loaded.parameters, loaded.scenario_name, loaded.seed) == ("me", {"pace": 1.2}, "here", 3)
    assert loaded.scenario.to_dict() == scenario.to_dict()
    steps = []
    loaded.verify(steps.append)
    assert steps == list(range(len(seen)))
    save_replay(loaded, tmp_path / "b.npz")
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_actions_and_rewards_are_those_of_the_env():
    env, gathered = ShepherdingEnv(SMALL, rewards="any"), []

    class Watched(Recorder):
        def step(self, action):
            answer = super().step(action)
            gathered.append((np.array(action), answer[1], answer[4]))
            return answer

    watched = Watched(env)
    run_episode(Pacing(), watched, 5)
    replay = watched.replay()
    assert list(replay.rewards) == ["occupy", "distance", "occlude"]
    for t, (action, reward, info) in enumerate(gathered):
        assert replay.actions[t].tobytes() == action.tobytes()
        assert sum(values[t] for values in replay.rewards.values()) == reward
        assert all(values[t] == info[f"reward/{name}"] for name, values in replay.rewards.items())
    assert replay.in_goal.tolist() == [int(state.sheep_in_goal.sum()) for state in replay]


def test_recording_changes_nothing_in_the_episode():
    plain = run_episode(StrombomTeam(), ShepherdingEnv(SMALL, rewards={}, lidar=None), 11)
    row, replay = recorded(StrombomTeam(), ShepherdingEnv(SMALL, lidar=None), 11)
    assert row == plain
    assert replay.controller == "StrombomTeam"
    assert replay.parameters == StrombomTeam().to_dict()


def test_an_own_scenario_can_be_looked_at_without_its_classes(tmp_path):
    save_replay(record(Pacing(), ShepherdingEnv(CASES["own"]), 3), tmp_path / "own.npz")
    stranger = load_replay(tmp_path / "own.npz")
    friend = load_replay(tmp_path / "own.npz", classes=OWN)
    for one, other in zip(stranger, friend, strict=True):
        assert difference(one, other) is None
    assert stranger.obstacles[0].kind == friend.scenario.to_dict()["obstacles"][0]["kind"]
    for kept, real in zip(outlines(stranger.obstacles[0], 0), outlines(Rock(), 0), strict=True):
        assert {tuple(p) for p in kept.points.tolist()} == {tuple(p) for p in real.points.tolist()}
        assert kept.radius == real.radius
    places = np.array([[-9.0, 5.0], [0.0, 0.0], [9.0, 9.0]])
    here, there = (r[0].surroundings.static_distances(places)[0] for r in (stranger, friend))
    assert np.allclose(here, there, rtol=0, atol=1e-12)
    with pytest.raises(SettingsError, match="was not handed over"):
        stranger.verify()
    friend.verify()


def test_verify_names_the_first_step_that_differs(file, tmp_path):
    def nudged(states):
        states[9, 2, 0] = np.nextafter(states[9, 2, 0], np.inf)
        return states

    changed = load_replay(rewritten(file, tmp_path / "c.npz", arrays={"sheep_pos": nudged}))
    with pytest.raises(ReplayError, match="^step 9: sheep_pos differs from the recorded one when played again$"):
        changed.verify()
    other = load_replay(rewritten(file, tmp_path / "d.npz", lambda header: header.update(seed=8, version="0.0.1")))
    with pytest.raises(ReplayError, match=r"step 0: .*\(recorded by version 0.0.1: "):
        other.verify()


def test_states_are_found_like_those_of_a_list(file):
    replay = load_replay(file)
    assert [state.step for state in replay] == list(range(26))
    assert replay[-1].step == 25
    assert replay[-1].time == 25 * SMALL.control_dt
    for wrong in (26, -27):
        with pytest.raises(IndexError, match="0 to 25"):
            replay[wrong]


def test_numpy_opens_a_file(file):
    arrays = np.load(file, allow_pickle=False)
    assert np.array_equal(arrays["sheep_pos"], load_replay(file).states["sheep_pos"])


def setting(**values):
    return lambda header: header.update(values)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"change_header": setting(format_version=2)}, "format 2"),
        ({"change_header": setting(format="another")}, "is not a replay"),
        ({"change_header": setting(n_steps=24)}, "damaged"),
        ({"change_header": setting(n_steps=10**7)}, f"at most {MAX_BYTES / 1e9:.1f} GB"),
        ({"change_header": setting(n_steps=10**30)}, "whole numbers"),
        ({"change_header": setting(n_steps=True)}, "whole numbers"),
        ({"change_header": setting(n_sheep=-1)}, "whole numbers"),
        ({"change_header": setting(rewards=["a", "a", "b"])}, "different names"),
        ({"change_header": setting(rewards="abc")}, "different names"),
        ({"change_header": setting(seed=-1)}, "seed"),
        ({"change_header": setting(controller=3)}, "must be text"),
        ({"change_header": setting(parameters=[])}, "must be tables"),
        ({"change_header": setting(scenario={"n_sheep": 8})}, "other numbers"),
        ({"change_header": setting(scenario={"nonsense": 8})}, "nonsense"),
        ({"change_header": setting(obstacles=[{"is": {"kind": "Nothing"}, "outlines": []}])}, "unknown kind"),
        ({"change_header": setting(obstacles=[{"is": {"kind": "os:system"}, "outlines": []}])}, "gave no shape"),
        ({"change_header": setting(obstacles=[{"is": {"kind": "a:B"}, "outlines": [[[[0, 0]], -1]]}])}, "finite"),
        ({"change_header": setting(obstacles=[{"is": {"kind": "a:B"}, "outlines": [[[["x"]], 1]]}])}, "outline"),
        ({"change_header": setting(obstacles=[{"is": {"kind": "a:B"}, "outlines": [7]}])}, "whole replay"),
        ({"change_header": setting(obstacles=[5])}, "must be a table"),
        ({"change_header": setting(seed=8), "resign": False}, "checksum"),
        ({"arrays": {"sheep_pos": lambda a: a * np.nan}}, "sheep_pos holds a number that is not finite"),
        ({"arrays": {"actions": lambda a: a + np.inf}}, "actions holds a number that is not finite"),
        ({"arrays": {"sheep_pos": lambda a: a[:, :, :1]}}, "sheep_pos must be"),
        ({"arrays": {"sheep_pos": lambda a: a.astype(np.float32)}}, "sheep_pos must be"),
        ({"arrays": {"sheep_pos": lambda a: np.zeros((2000, 8, 2))}}, "larger than it can be"),
        ({"arrays": {"sheep_in_goal": lambda a: a.view(np.uint8) + np.uint8(2)}}, "sheep_in_goal"),
        ({"rename": {"sheep_vel.npy": "other.npy"}}, "other arrays"),
        ({"rename": {"sheep_vel.npy": None}}, "other arrays"),
        ({"rename": {"header.json": None}}, "is not a replay"),
    ],
)
def test_a_file_that_is_no_episode_is_refused_in_one_line(changes, said, file, tmp_path):
    path = rewritten(file, tmp_path / "bad.npz", **changes)
    with pytest.raises(ReplayError, match="(?s)" + said) as caught:
        load_replay(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_a_damaged_file_is_refused(file, tmp_path):
    whole = file.read_bytes()
    rng = np.random.default_rng(0)
    bad = tmp_path / "bad.npz"
    for content in [b"", b"text", whole[: len(whole) // 2], whole[:-1], b"PK" + rng.bytes(500)]:
        bad.write_bytes(content)
        with pytest.raises(ReplayError, match=str(bad)):
            load_replay(bad)
    untouched = load_replay(file)
    for _ in range(60):
        flipped = bytearray(whole)
        flipped[rng.integers(len(whole))] ^= 1 << int(rng.integers(8))
        bad.write_bytes(flipped)
        try:
            survivor = load_replay(bad)  # the bit may be one that says nothing, such as a date
        except ReplayError as error:
            assert "\n" not in str(error)
        else:
            assert all(difference(a, b) is None for a, b in zip(survivor, untouched, strict=True))
    for missing in (tmp_path / "none.npz", tmp_path):
        with pytest.raises(ReplayError, match="cannot be read"):
            load_replay(missing)


def test_a_file_is_written_whole_or_not_at_all(file, tmp_path, monkeypatch):
    replay = load_replay(file)
    path = tmp_path / "a.npz"
    path.write_text("earlier")
    monkeypatch.setattr(zipfile.ZipFile, "writestr", lambda *_: (_ for _ in ()).throw(OSError(28, "No space left")))
    with pytest.raises(ReplayError, match="cannot be written .No space left"):
        save_replay(replay, path)
    assert path.read_text() == "earlier"
    assert [p.name for p in tmp_path.iterdir()] == ["a.npz"]
    with pytest.raises(ReplayError, match="cannot be written"):
        save_replay(replay, tmp_path / "no" / "a.npz")


def test_what_cannot_be_told_cannot_be_written(file, tmp_path):
    replay = load_replay(file)
    values = {name: getattr(replay, name) for name in Replay.__dataclass_fields__}
    with pytest.raises(ReplayError, match="cannot be written"):
        save_replay(Replay(**{**values, "parameters": {"rng": object()}}), tmp_path / "a.npz")
    with pytest.raises(ReplayError, match="actions holds a number that is not finite"):
        save_replay(Replay(**{**values, "actions": replay.actions * np.nan}), tmp_path / "a.npz")
    assert not list(tmp_path.iterdir())


def test_a_recorder_needs_a_seed_and_a_step():
    recorder = Recorder(ShepherdingEnv(SMALL))
    with pytest.raises(ReplayError, match="seed"):
        recorder.reset()
    recorder.reset(seed=1)
    with pytest.raises(ReplayError, match="nothing has been recorded"):
        recorder.replay()


@pytest.mark.parametrize("thing", SOLID, ids=lambda thing: type(thing).__name__)
def test_outlines_are_the_shapes(thing):
    body = pymunk.Space().static_body
    for outline, real in zip(outlines(thing, 0), thing.shapes(body), strict=True):
        again = outline.shape(pymunk.Space().static_body)
        assert type(again) is type(real)
        assert again.cache_bb() == pytest.approx(real.cache_bb())
        for point in np.random.default_rng(0).uniform(-25, 25, (50, 2)).tolist():
            assert again.point_query(point).distance == pytest.approx(real.point_query(point).distance, abs=1e-9)


@pytest.mark.parametrize(
    ("points", "radius"), [([], 1), ([[1, 2, 3]], 1), ([[np.nan, 0]], 1), ([[0, 0]], -1), ("x", 1), ([[0, 0]], None)]
)
def test_what_is_no_outline(points, radius):
    with pytest.raises(SettingsError, match="^outline: "):
        Outline(points, radius)
