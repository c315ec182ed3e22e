"""``Shepherding-v0`` as Gymnasium and stable-baselines3 see it."""

import math
import pickle
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import FlattenObservation

import shepherd_phys.envs  # noqa: F401 (registers)
from shepherd_phys.envs import ShepherdingEnv
from shepherd_phys.lidar import Lidar
from shepherd_phys.obstacles import Wall
from shepherd_phys.scenario import SCENARIOS, Scenario
from shepherd_phys.settings import SettingsError

ID = "shepherd_phys.envs:Shepherding-v0"

VARIANTS = {
    "paper": {},
    "small": {"scenario": "small"},
    "original": {"scenario": "small", "rewards": "original"},
    "any": {"scenario": "small", "rewards": "any"},
    "no rewards": {"scenario": "small", "rewards": {}},
    "no lidar": {"scenario": "small", "lidar": None},
    "neither": {"scenario": "small", "lidar": None, "rewards": {}},
    "sectors": {"scenario": "small", "lidar": Lidar(sectors=64)},
    "goal frame": {"scenario": "small", "lidar": Lidar(sectors=64, frame="goal")},
    "paper layout": {"scenario": "small", "lidar": Lidar(layout="paper")},
    "one shepherd": {"scenario": SCENARIOS["small"].but(shepherds=1)},
    "obstacles": {"scenario": SCENARIOS["small"].but(obstacles=(Wall((-5, 0), (5, 1)),))},
}


@pytest.mark.parametrize("variant", VARIANTS)
def test_gymnasium_check_env_without_a_warning(variant, monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")  # it tries render_mode human, too
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gym.make(ID, disable_env_checker=True, render_mode="rgb_array", **VARIANTS[variant]).unwrapped
        check_env(env)


@pytest.mark.parametrize("variant", ["paper", "sectors"])
def test_sb3_check_env_on_a_flattened_env_without_a_warning(variant):
    sb3 = pytest.importorskip("stable_baselines3.common.env_checker")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sb3.check_env(FlattenObservation(ShepherdingEnv(**VARIANTS[variant])))


@pytest.mark.parametrize(
    ("variant", "shape"),
    [
        ("paper", (3, 9, 512)),
        ("sectors", (2, 9, 64)),
        ("paper layout", (2, 1536, 1, 3)),
        ("one shepherd", (1, 9, 512)),
        ("obstacles", (2, 12, 512)),
        ("no lidar", (2, 0)),
    ],
)
def test_observation_shapes(variant, shape):
    env = ShepherdingEnv(**VARIANTS[variant])
    observation, _ = env.reset(seed=0)
    assert observation.shape == env.observation_space.shape == shape
    assert env.observation_space.contains(observation)


def run(env, seed, steps):
    observation, info = env.reset(seed=seed)
    seen = [(observation, 0.0, info)]
    rng = np.random.default_rng(seed)
    for _ in range(steps):
        observation, reward, _, _, info = env.step(rng.uniform(-1, 1, env.action_space.shape).astype(np.float32))
        seen.append((observation, reward, info))
    return seen


def test_a_seed_replays_everything_exactly():
    first, second = (run(ShepherdingEnv("small"), 11, 25) for _ in range(2))
    for (a, r, i), (b, s, j) in zip(first, second, strict=True):
        assert a.tobytes() == b.tobytes()
        assert (r, i) == (s, j)


def test_resets_without_a_seed_follow_from_the_last_one():
    def goals(env, seed):
        env.reset(seed=seed)
        return [tuple(env.reset()[0].shape and env.state.goal_pos) for _ in range(3)]

    assert goals(ShepherdingEnv("small"), 4) == goals(ShepherdingEnv("small"), 4)
    assert len(set(goals(ShepherdingEnv("small"), 4))) == 3


def test_info_keys_and_types_are_the_same_at_every_step():
    seen = run(ShepherdingEnv("small"), 0, 5)
    for _, _, info in seen:
        assert {k: type(v) for k, v in info.items()} == {k: type(v) for k, v in seen[0][2].items()}
        assert all(isinstance(v, bool | int | float) for v in info.values())
    assert set(seen[0][2]) == {
        "in_goal",
        "ever_in_goal",
        "path_length",
        "collisions",
        "is_success",
        "reward/occupy",
        "reward/distance",
        "reward/occlude",
        "share/occlude/0",
        "share/occlude/1",
    }


def test_rewards_are_plain_floats_and_the_sum_of_their_terms():
    for _, reward, info in run(ShepherdingEnv("small"), 3, 10)[1:]:
        assert type(reward) is float
        assert reward == pytest.approx(sum(v for k, v in info.items() if k.startswith("reward/")), abs=1e-15)


def test_truncates_itself_at_t_and_never_terminates():
    env = gym.make(ID, scenario=SCENARIOS["small"].but(n_steps=7))
    env.reset(seed=0)
    ends = [env.step(np.zeros((2, 2), np.float32))[2:4] for _ in range(7)]
    assert ends == [(False, False)] * 6 + [(False, True)]
    with pytest.raises(gym.error.ResetNeeded, match="the episode ended after 7 steps"):
        env.unwrapped.step(np.zeros((2, 2)))


def delivered(scenario):
    env = ShepherdingEnv(scenario, rewards={}, lidar=None)
    env.reset(seed=0)
    state = env.state.but(sheep_pos=env.state.goal_pos + (env.state.sheep_pos - env.state.sheep_pos.mean(axis=0)) * 0.3)
    far = state.goal_pos + [[30.0, 0.0], [0.0, 30.0]]
    env.world.reset_to(state.but(shepherd_pos=far), 0)
    return env


def test_terminates_on_success_after_five_seconds_if_asked():
    one = SCENARIOS["small"].but(n_flocks=1)
    env = delivered(one.but(terminate_on_success=True))
    ends = []
    while not ends or not any(ends[-1]):
        _, _, terminated, truncated, info = env.step(np.zeros((2, 2)))
        assert info["is_success"]
        ends.append((terminated, truncated))
    assert len(ends) == 26  # the first reading follows the first step, the last is 5 s of 0.2 s later
    assert ends[-1] == (True, False)
    env = delivered(one)
    assert not any(env.step(np.zeros((2, 2)))[2] for _ in range(40))


def test_five_seconds_are_five_seconds_from_the_reading_that_first_saw_it():
    env = ShepherdingEnv("small", rewards={}, lidar=None)
    env.reset(seed=0)
    readings = [
        (1.0, False),
        (1.2, True),
        (6.0, True),
        (6.2, True),
        (6.4, False),
        (6.6, True),
        (11.4, True),
        (11.6, True),
    ]
    assert [env._held(env.state.but(time=time), success) for time, success in readings] == [
        *(False, False, False, True),
        *(False, False, False, True),
    ]
    coarse = SCENARIOS["small"].but(control_dt=10.5, terminate_on_success=True)
    env = ShepherdingEnv(coarse, rewards={}, lidar=None)
    env.reset(seed=0)
    assert not env.step(np.zeros((2, 2)))[2]


def test_the_stack_is_filled_by_the_first_frame_and_then_moves():
    env = ShepherdingEnv("small")
    first, _ = env.reset(seed=5)
    frames = first.reshape(2, 3, 3, 512)
    assert (frames[:, 0] == frames[:, 2]).all() and (frames[:, 1] == frames[:, 2]).all()
    second, *_ = env.step(np.ones((2, 2)))
    assert (second.reshape(2, 3, 3, 512)[:, 1] == frames[:, 2]).all()
    third, *_ = env.step(np.ones((2, 2)))
    assert (third.reshape(2, 3, 3, 512)[:, 1] == second.reshape(2, 3, 3, 512)[:, 2]).all()
    again, _ = env.reset(seed=5)
    assert again.tobytes() == first.tobytes()


def test_goal_frame_rolls_by_beam_offset_and_leaves_actions_alone():
    plain, turned = (ShepherdingEnv("small", lidar=lidar) for lidar in (Lidar(), Lidar(frame="goal")))
    a, b = plain.reset(seed=2)[0], turned.reset(seed=2)[0]
    for _ in range(5):
        for p in range(2):
            assert (np.roll(a[p], -turned.beam_offset[p], axis=1) == b[p]).all()
            to_goal = turned.state.goal_pos - turned.state.shepherd_pos[p]
            straight = math.atan2(to_goal[1], to_goal[0]) / (2 * math.pi) * 512
            assert abs((turned.beam_offset[p] - straight + 256) % 512 - 256) <= 1
        action = np.array([[1.0, 0.0], [0.0, 1.0]])
        a, b = plain.step(action)[0], turned.step(action)[0]
        assert plain.state.shepherd_pos.tobytes() == turned.state.shepherd_pos.tobytes()


def test_without_lidar_and_rewards_nothing_is_scanned():
    env = ShepherdingEnv("small", rewards={}, lidar=None)
    env.reset(seed=0)
    _, reward, _, _, info = env.step(np.zeros((2, 2)))
    assert env.scan is None
    assert reward == 0.0
    assert not [k for k in info if "/" in k]


def test_the_physics_does_not_depend_on_what_is_observed_or_rewarded():
    envs = [ShepherdingEnv(**VARIANTS[name]) for name in ("small", "neither", "goal frame", "paper layout")]
    for env in envs:
        run(env, 8, 20)
    assert len({env.state.sheep_pos.tobytes() for env in envs}) == 1


@pytest.mark.parametrize("mode", ["sync", "async"])
def test_make_vec(mode):
    envs = gym.make_vec(ID, num_envs=2, vectorization_mode=mode, scenario="small")
    try:
        observations, _ = envs.reset(seed=3)
        assert observations.shape == (2, 2, 9, 512)
        alone = ShepherdingEnv("small")
        assert (observations[1] == alone.reset(seed=4)[0]).all()
        observations, rewards, _, _, info = envs.step(np.zeros((2, 2, 2), np.float32))
        assert (observations[1] == alone.step(np.zeros((2, 2)))[0]).all()
        assert rewards.shape == (2,)
        assert info["in_goal"].shape == (2,)
    finally:
        envs.close()


def test_envs_can_be_pickled_before_their_first_reset():
    env = pickle.loads(pickle.dumps(ShepherdingEnv("small", lidar=Lidar(sectors=64))))
    assert env.reset(seed=0)[0].tobytes() == ShepherdingEnv("small", lidar=Lidar(sectors=64)).reset(seed=0)[0].tobytes()


def test_render_gives_a_picture_of_the_asked_size():
    env = ShepherdingEnv("small", render_mode="rgb_array", render_size=(320, 200))
    env.reset(seed=0)
    picture = env.render()
    assert (picture.shape, picture.dtype) == ((200, 320, 3), np.uint8)
    env.step(np.ones((2, 2)))
    assert (env.render() != picture).any()
    assert ShepherdingEnv("small").render() is None


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"scenario": "desert"}, "scenario: 'desert' is neither"),
        ({"scenario": "no.toml"}, "no.toml: cannot be read"),
        ({"lidar": "radar"}, "lidar: needs a Lidar, None or 'default'"),
        ({"render_mode": "ascii"}, "render_mode: 'ascii' is not one of"),
    ],
)
def test_bad_arguments(arguments, message):
    with pytest.raises(SettingsError, match=message):
        ShepherdingEnv(**arguments)


def test_bad_actions_and_options_are_one_clear_error_and_nothing_moves():
    env = ShepherdingEnv("small")
    env.reset(seed=0)
    before = env.state
    with pytest.raises(FloatingPointError, match="action"):
        env.step(np.full((2, 2), np.nan))
    with pytest.raises(ValueError, match=r"action: needs shape \(2, 2\)"):
        env.step(np.zeros(4))
    assert env.state is before
    with pytest.raises(SettingsError, match="options: none are known"):
        env.reset(options={"wind": 3})


def test_terms_that_give_nonsense_are_named():
    class Shares:
        def __init__(self, answer):
            self.answer = answer

        def shares(self, before, after, scan, scenario):
            return self.answer

        def __call__(self, before, after, scan, scenario):
            return 0.0

    cases = [
        (lambda *_: math.nan, r"rewards\['odd'\]: the term gave nan, which is not finite"),
        (lambda *_: None, r"rewards\['odd'\]: the term must give a number \(given: None"),
        (Shares([1.0]), r"rewards\['odd'\].shares: needs shape \(2,\)"),
        (Shares([1.0, math.inf]), r"rewards\['odd'\]: the term gave inf"),
    ]
    for term, message in cases:
        env = ShepherdingEnv("small", rewards={"odd": (1.0, term)}, lidar=None)
        env.reset(seed=0)
        with pytest.raises(ValueError, match=message):
            env.step(np.zeros((2, 2)))


def test_a_term_may_want_the_scan_of_wild_sheep_alone():
    class Seen:
        scans = ("wild",)

        def __call__(self, before, after, scan, scenario):
            return float(np.isfinite(scan["wild"]).sum())

    env = ShepherdingEnv("small", rewards={"seen": (1.0, Seen())}, lidar=None)
    env.reset(seed=0)
    assert env.step(np.zeros((2, 2)))[1] > 0


def test_a_flock_that_fears_nothing_can_be_drawn():
    flock = SCENARIOS["small"].flock.but(detection_radius=0.0)
    env = ShepherdingEnv(SCENARIOS["small"].but(flock=flock), render_mode="rgb_array", render_size=(80, 60))
    env.reset(seed=0)
    assert env.render().shape == (60, 80, 3)


def test_no_shepherds_at_all():
    env = ShepherdingEnv(Scenario(n_sheep=5, n_flocks=1, shepherds=0, n_steps=20), rewards="wild")
    observation, _ = env.reset(seed=0)
    assert observation.shape == (0, 9, 512)
    _, reward, *_ = env.step(np.zeros((0, 2)))
    assert math.isfinite(reward)
