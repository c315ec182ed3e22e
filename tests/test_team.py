"""The team's vector env: the same numbers as ShepherdingEnv, right ends of episodes, reproducible, fit for SB3."""

import numpy as np
import pytest
from team_scenes import SMALL, Constant, Fails, alternating, episode_seeds, no_scenario, view

pytest.importorskip("stable_baselines3")

from stable_baselines3 import PPO
from stable_baselines3.common.buffers import DictRolloutBuffer
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

from shepherd_phys import mirror
from shepherd_phys.envs import WILD, ShepherdingEnv
from shepherd_phys.envs import _critic as critic
from shepherd_phys.envs.rewards import Effort
from shepherd_phys.envs.team import TeamVecEnv
from shepherd_phys.lidar import Lidar
from shepherd_phys.observation import turn
from shepherd_phys.obstacles import Pillar
from shepherd_phys.placement import PlacementError
from shepherd_phys.scenario import SCENARIOS
from shepherd_phys.settings import SettingsError

COMPACT = Lidar(sectors=64)
SCHEME = {**WILD, "effort": (-0.5, Effort())}


def actions(env, rng):
    return rng.uniform(-1, 1, (env.num_envs, 2)).astype(np.float32)


def followed(n_steps=30, root=5, **arguments):
    """Everything that some steps with random actions give, as plain data."""
    env = TeamVecEnv(seed=root, **arguments)
    try:
        seen = [{name: part.tobytes() for name, part in env.reset().items()}]
        rng = np.random.default_rng(0)
        for _ in range(n_steps):
            observation, rewards, dones, infos = env.step(actions(env, rng))
            for info in infos:
                info.get("episode", {}).pop("t", None)
                if info:
                    last = info.pop("terminal_observation")
                    info["last"] = {name: part.tobytes() for name, part in last.items()}
            seen.append(({name: part.tobytes() for name, part in observation.items()}, rewards.tobytes(), infos))
            seen.append(dones.tolist())
        return seen, env.shepherd_steps
    finally:
        env.close()


# ------------------------------------------------------------ the same numbers as ShepherdingEnv


LIDARS = {
    "world frame": COMPACT,
    "goal frame": Lidar(sectors=64, frame="goal"),
    "all beams, strided": Lidar(stack=2, stack_stride=3),
}


@pytest.mark.parametrize("credit", ["team", "own"])
@pytest.mark.parametrize("interval", [1, 5])
@pytest.mark.parametrize("lidar", LIDARS.values(), ids=LIDARS)
def test_observations_and_rewards_are_those_of_shepherding_env_to_the_bit(lidar, interval, credit):
    team = TeamVecEnv(
        SMALL,
        (2, 3),
        rewards=SCHEME,
        lidar=lidar,
        decision_interval=interval,
        credit=credit,
        random_clocks=False,
        seed=77,
    )
    singles = [ShepherdingEnv(SMALL.but(shepherds=p), rewards=SCHEME, lidar=lidar) for p in (2, 3)]
    seeds = [episode_seeds(77, 0, world) for world in (0, 1)]
    expected = [env.reset(seed=next(seed))[0] for env, seed in zip(singles, seeds, strict=True)]
    observation = team.reset()["lidar"]
    assert observation.tobytes() == np.concatenate(expected).tobytes()
    rng = np.random.default_rng(1)
    for _ in range(40):
        action = actions(team, rng)
        observation, rewards, dones, infos = team.step(action)
        for world, env in enumerate(singles):
            slots = np.flatnonzero(team.slot_world == world)
            wanted = turn(action[slots], env.beam_offset, lidar.beams) if lidar.frame == "goal" else action[slots]
            total = np.zeros(len(slots))
            truncated = False
            for _ in range(interval):
                last, reward, _, truncated, info = env.step(wanted)
                if credit == "team":
                    total += reward
                else:
                    own = np.zeros(len(slots))
                    for name, (weight, _) in SCHEME.items():
                        shares = [info.get(f"share/{name}/{k}") for k in range(len(slots))]
                        own += info[f"reward/{name}"] if None in shares else weight * np.array(shares)
                    total += own
                if truncated:
                    break
            assert rewards[slots].tobytes() == total.astype(np.float32).tobytes()
            assert dones[slots].tolist() == [truncated] * len(slots)
            if truncated:
                rows = [infos[slot]["terminal_observation"]["lidar"] for slot in slots]
                assert np.array(rows).tobytes() == last.tobytes()
                last, _ = env.reset(seed=next(seeds[world]))
            assert observation["lidar"][slots].tobytes() == last.tobytes()
    assert team.shepherd_steps == 40 * 5 * (interval == 1) + (interval == 5) * (40 // 3 * 12 + 5) * 5


def test_the_goal_frame_follows_every_scan_even_those_that_nobody_acts_on():
    """A shepherd inside the goal keeps the last angle that it had outside: of a control step, not of a decision."""
    near = SMALL.but(shepherds=1, goal_pos=(0.0, 0.0), box=8.0, flock_distance=(10.0, 10.0), n_steps=40)
    lidar = Lidar(sectors=64, frame="goal")
    env = ShepherdingEnv(near, lidar=lidar)
    team = TeamVecEnv(near, (1,), lidar=lidar, decision_interval=4, random_clocks=False, seed=3)
    env.reset(seed=next(episode_seeds(3, 0, 0)))
    team.reset()
    inside = 0
    for k in range(9):
        action = np.array([[0.9, 0.45 * (-1) ** k]], np.float32)
        wanted = turn(action, env.beam_offset, lidar.beams)
        for _ in range(4):
            last, *_ = env.step(wanted)
        inside += int(np.linalg.norm(env.state.shepherd_pos) < near.goal_radius)
        assert team.step(action)[0]["lidar"].tobytes() == last.tobytes()
    assert inside >= 3


@pytest.mark.parametrize("side", ["left", "right"])
def test_mirrored_shepherds_see_and_mean_the_other_side(side):
    lidar = Lidar(sectors=64, frame="goal")
    how = dict(scenario=SMALL, team_sizes=(2, 3), lidar=lidar, decision_interval=3, critic="world", seed=3)
    plain, other = TeamVecEnv(**how), TeamVecEnv(**how, mirror=side)
    rng, whos = np.random.default_rng(0), []
    straight, seen = plain.reset(), other.reset()
    who = mirror.mirrored(side, straight["lidar"], lidar)
    dones = np.zeros(5, bool)
    for _ in range(60):
        whos.append(who)
        np.testing.assert_array_equal(seen["lidar"], mirror.seen(straight["lidar"], who))
        np.testing.assert_array_equal(seen["critic"][~who], straight["critic"][~who])
        assert (seen["critic"][who] != straight["critic"][who]).any(axis=1).all()
        wanted = actions(plain, rng)
        straight, rewards, dones, _ = plain.step(mirror.meant(wanted, who))
        seen, same, _, _ = other.step(wanted)
        np.testing.assert_array_equal(rewards, same)
        who = np.where(dones, mirror.mirrored(side, straight["lidar"], lidar), who)
    whos = np.array(whos)
    assert whos.any() and not whos.all() and (whos.any(axis=0) & ~whos.all(axis=0)).any()  # episodes differ
    plain.close()
    other.close()


def test_a_mirror_needs_the_goal_ahead():
    with pytest.raises(SettingsError, match="mirror: needs the frame 'goal'"):
        TeamVecEnv(SMALL, lidar=COMPACT, mirror="left")
    with pytest.raises(SettingsError, match="mirror"):
        TeamVecEnv(SMALL, lidar=Lidar(frame="goal"), mirror="up")


def test_shares_average_to_the_teams_reward():
    both = [TeamVecEnv(SMALL, (3,), rewards=SCHEME, lidar=COMPACT, credit=credit, seed=4) for credit in ("team", "own")]
    for env in both:
        env.reset()
    rng = np.random.default_rng(0)
    differ = False
    for _ in range(12):
        action = actions(both[0], rng)
        team, own = (env.step(action)[1] for env in both)
        assert np.ptp(team) == 0
        assert own.mean() == pytest.approx(team[0], rel=1e-5)
        differ |= bool(np.ptp(own) > 0)
    assert differ


def test_bodies_of_a_team_are_the_scenarios_in_turn():
    slow, fast = SMALL.shepherds[0].but(max_speed=1.0), SMALL.shepherds[0].but(max_speed=2.0)
    env = TeamVecEnv(SMALL.but(shepherds=(slow, fast)), (1, 3, 2))
    env.reset()
    assert [s.shepherds for s in env.get_attr("scenario", [0, 1, 4])] == [(slow,), (slow, fast, slow), (slow, fast)]
    with pytest.raises(SettingsError, match="has no shepherds of which to make a team of 2"):
        TeamVecEnv(SMALL.but(shepherds=0), (2,)).reset()


def test_obstacles_are_observed_where_the_scenario_has_some():
    env = TeamVecEnv(SMALL.but(obstacles=(Pillar((15.0, 15.0), 1.0),), box=20.0), (2,))
    assert env.observation_space["lidar"].shape == (12, 512)
    assert env.reset()["lidar"].reshape(2, 3, 4, 512)[:, :, 3].any()


def test_the_critic_sees_the_frame_of_the_observation_and_no_clock():
    env = TeamVecEnv(SMALL, (3,), lidar=Lidar(sectors=64, frame="goal"), critic="world", random_clocks=False)
    observation = env.reset()
    for k in range(10):
        (state, *_), (offset, *_) = env.get_attr("state"), env.get_attr("beam_offset")
        assert observation["critic"].tobytes() == view(state, 2 * np.pi / 512 * offset).tobytes()
        if k < 9:
            assert view(state.but(step=5, time=1.0), [0.0] * 3).tobytes() == view(state, [0.0] * 3).tobytes()
        observation, *_ = env.step(np.full((3, 2), 0.7))
    away = -observation["critic"][:, 96]  # the goal lies straight ahead of everybody outside it
    assert (away > 0).all() and np.abs(observation["critic"][:, 97]).max() < 0.03
    assert env.observation_space.contains({name: part[0] for name, part in observation.items()})


# ------------------------------------------------------------ ends of episodes


def test_every_slot_of_an_ended_world_has_its_own_last_observation_and_the_right_flags():
    env = TeamVecEnv(SMALL, (1, 2), lidar=COMPACT, critic="world", decision_interval=5, random_clocks=False)
    env.reset()
    rng = np.random.default_rng(0)
    returns = np.zeros(3)
    for k in range(3):
        observation, rewards, dones, infos = env.step(actions(env, rng))
        returns += rewards
        if k < 2:
            assert infos == [{}, {}, {}] and not dones.any()
    assert dones.all()
    for slot, info in enumerate(infos):
        assert info["TimeLimit.truncated"] is True
        last = info["terminal_observation"]
        assert {name: part.shape for name, part in last.items()} == {"lidar": (9, 64), "critic": (critic.N_NUMBERS,)}
        assert all((last[name] != observation[name][slot]).any() for name in last)
        assert info["episode"]["r"] == info["return"] == pytest.approx(returns[slot], rel=1e-5)
        assert (info["episode"]["l"], info["control_steps"], info["shortened"]) == (3, 12, False)
        assert info["world"] == env.slot_world[slot]
        assert isinstance(info["is_success"], bool)
        assert {"in_goal", "ever_in_goal", "path_length", "collisions"} <= set(info)
    assert (infos[1]["terminal_observation"]["lidar"] != infos[2]["terminal_observation"]["lidar"]).any()


def test_success_that_ends_an_episode_is_no_time_out():
    huge = SMALL.but(goal_radius=60.0, terminate_on_success=True, n_steps=50)
    env = TeamVecEnv(huge, (2,), random_clocks=False, decision_interval=4)
    env.reset()
    ends = [env.step(np.zeros((2, 2)))[2:] for _ in range(7)]
    assert [bool(dones.all()) for dones, _ in ends] == [False] * 6 + [True]
    for info in ends[-1][1]:
        assert info["TimeLimit.truncated"] is False
        assert (info["is_success"], info["control_steps"]) == (True, 25)


def small_ppo(env, **arguments):
    return PPO("MultiInputPolicy", env, batch_size=20, n_epochs=1, device="cpu", seed=1, **arguments)


def rollout(model):
    """Fill the model's buffer as SB3 does, and keep what the env said at ends of episodes."""
    ends = []
    step = model.env.step

    def watched(action):
        answer = step(action)
        ends.append((answer[2].copy(), answer[3]))
        return answer

    model.env.step = watched
    _, callback = model._setup_learn(0, None)
    assert model.collect_rollouts(model.env, callback, model.rollout_buffer, model.n_steps)
    return ends


def test_ppo_bootstraps_every_time_out_with_the_value_of_its_own_last_observation():
    env = TeamVecEnv(
        SMALL, (1, 2), rewards={"one": (1.0, Constant(0.25))}, lidar=COMPACT, critic="world", decision_interval=5
    )
    model = small_ppo(env, n_steps=20, gamma=0.9)
    ends = rollout(model)
    buffer = model.rollout_buffer
    assert isinstance(buffer, DictRolloutBuffer)
    values, n_ends = [], 0
    for k, (dones, infos) in enumerate(ends):
        for slot in range(3):
            if not dones[slot]:
                assert buffer.rewards[k, slot] == pytest.approx(0.25 * 5)
                continue
            tensor, _ = model.policy.obs_to_tensor(infos[slot]["terminal_observation"])
            value = model.policy.predict_values(tensor).item()
            steps = infos[slot]["control_steps"] % 5 or 5
            assert buffer.rewards[k, slot] == pytest.approx(0.25 * steps + 0.9 * value, rel=1e-5)
            values.append(value)
            n_ends += 1
    assert n_ends >= 6
    assert np.ptp(values) > 1e-4  # it matters which observation was asked about


def test_returns_of_a_constant_reward_are_its_known_value_across_time_outs():
    """A reward of 1 a step is worth 1 / (1 - gamma) in every state, if and only if time-outs are bootstrapped."""
    env = TeamVecEnv(SMALL, (1, 2), rewards={"one": (1.0, Constant())}, lidar=COMPACT)
    model = small_ppo(env, n_steps=40, gamma=0.9, gae_lambda=1.0)
    model.policy.value_net.weight.data.zero_()
    model.policy.value_net.bias.data.fill_(10.0)
    ends = rollout(model)
    assert sum(dones.sum() for dones, _ in ends) >= 9
    assert model.rollout_buffer.returns == pytest.approx(np.full((40, 3), 10.0), rel=1e-5)


# ------------------------------------------------------------ randomness


def test_the_number_of_workers_changes_nothing():
    arguments = {
        "scenario": alternating,
        "team_sizes": (1, 3, 2),
        "lidar": Lidar(sectors=64, frame="goal"),
        "decision_interval": 2,
        "credit": "own",
        "critic": "world",
    }
    alone = followed(**arguments)
    assert any(info.get("episode") for entry in alone[0][1::2] for info in entry[2])
    for n_workers in (1, 2):
        assert followed(**arguments, n_workers=n_workers) == alone


def test_worlds_and_roots_have_streams_of_their_own():
    def starts(root):
        env = TeamVecEnv(SMALL, (2, 2, 2), seed=root)
        env.reset()
        return [tuple(state.goal_pos) for state in env.get_attr("state", [0, 2, 4])]

    assert starts(1) == starts(1)
    assert len({place for root in (1, 2, 3) for place in starts(root)}) == 9  # no root shares a world with a neighbour


def test_worlds_of_a_larger_env_are_those_of_a_smaller_one():
    small, large = (TeamVecEnv(SMALL, sizes, lidar=COMPACT, seed=9) for sizes in ((2, 3), (2, 3, 1)))
    a, b = small.reset()["lidar"], large.reset()["lidar"]
    for _ in range(15):
        assert a.tobytes() == b[:5].tobytes()
        a, b = small.step(np.ones((5, 2)))[0]["lidar"], large.step(np.ones((6, 2)))[0]["lidar"]


def test_random_clocks_shorten_the_first_episode_alone():
    scenario = SMALL.but(n_steps=10)
    env = TeamVecEnv(scenario, (1,) * 30, lidar=COMPACT, rewards={"one": (1.0, Constant())})
    env.reset()
    lengths = {slot: [] for slot in range(30)}
    for _ in range(30):
        _, _, dones, infos = env.step(np.zeros((30, 2)))
        for slot in np.flatnonzero(dones):
            info = infos[slot]
            lengths[slot].append(info["control_steps"])
            assert info["return"] == info["control_steps"]
            assert info["shortened"] == (len(lengths[slot]) == 1 and info["control_steps"] < 10)
            assert ("episode" in info, "is_success" in info) == (not info["shortened"],) * 2
    first = [found[0] for found in lengths.values()]
    assert all(found[1:] == [10] * len(found[1:]) for found in lengths.values())
    assert len(set(first)) >= 6 and min(first) >= 1 and max(first) <= 10


def test_a_restart_depends_on_settings_root_and_number_alone():
    def after(env, number):
        rng = np.random.default_rng(number)
        seen = [env.restart(number)["lidar"].tobytes()]
        for _ in range(20):
            observation, _, dones, _ = env.step(actions(env, rng))
            seen.append((observation["lidar"].tobytes(), dones.tolist()))
        return seen

    long, fresh = (TeamVecEnv(SMALL, (1, 2), lidar=COMPACT, seed=8) for _ in range(2))
    first = long.reset()["lidar"].tobytes()
    three, four = after(long, 3), after(long, 4)
    assert after(fresh, 4) == four != three
    assert after(fresh, 3) == three
    assert fresh.reset()["lidar"].tobytes() == four[0]  # the one after the last
    assert fresh.seed(8) == [8, 8, 8]
    assert fresh.reset()["lidar"].tobytes() == first  # the first one of a root
    with pytest.raises(SettingsError, match=r"number: needs a whole number, 0 or more \(given: -1\)"):
        fresh.restart(-1)


def test_seeds_given_by_ppo_are_the_root():
    env = TeamVecEnv(SMALL, (2,), lidar=COMPACT, seed=3)
    small_ppo(env, n_steps=10)
    assert env.root == 1
    assert env.reset()["lidar"].tobytes() == TeamVecEnv(SMALL, (2,), lidar=COMPACT, seed=1).reset()["lidar"].tobytes()
    roots = {env.seed()[0] for _ in range(3)}
    assert len(roots) == 3


def test_an_episode_may_be_another_scenario_than_the_last():
    env = TeamVecEnv(alternating, (2,), lidar=COMPACT, random_clocks=False)
    env.reset()
    found = set()
    for _ in range(60):
        (scenario, _) = env.get_attr("scenario")
        found.add((scenario.n_flocks, scenario.n_steps))
        _, _, dones, infos = env.step(np.zeros((2, 2)))
        assert not dones[0] or infos[0]["control_steps"] == scenario.n_steps
    assert len(found) >= 4


# ------------------------------------------------------------ SB3's interface


def test_spaces_and_slots():
    env = TeamVecEnv(SMALL, (1, 2, 3, 4, 5, 6), lidar=COMPACT)
    assert env.num_envs == 21
    assert env.slot_world.tolist() == [w for w, n in enumerate(range(1, 7)) for _ in range(n)]
    assert set(env.observation_space.spaces) == {"lidar"}
    assert env.observation_space["lidar"].shape == (9, 64)
    assert env.action_space.shape == (2,)
    observation = env.reset()
    observation["lidar"][:] = -1.0  # the caller's own
    after, rewards, *_ = env.step(np.zeros((21, 2)))
    assert (after["lidar"] >= 0).all()
    rewards[:] = 99.0
    assert (env.step(np.zeros((21, 2)))[1] < 99.0).all()
    env.close()
    env.close()


@pytest.mark.parametrize("n_workers", [0, 2])
def test_attributes_and_methods_of_worlds(n_workers):
    env = TeamVecEnv(SMALL, (1, 2), lidar=COMPACT, n_workers=n_workers, render_mode="rgb_array")
    try:
        env.reset()
        assert env.get_attr("index") == [0, 1, 1]
        assert env.get_attr("n_shepherds", [2, 0]) == [2, 1]
        assert env.get_attr("render_mode", 0) == ["rgb_array"]
        env.set_attr("remark", "wool", indices=[1])
        assert env.get_attr("remark", [2]) == ["wool"]
        assert not env.has_attr("remark")
        with pytest.raises(AttributeError, match="remark"):
            env.get_attr("remark", 0)
        pictures = env.env_method("render", (40, 30), indices=[0, 1, 2])
        assert [picture.shape for picture in pictures] == [(30, 40, 3)] * 3
        assert (pictures[1] == pictures[2]).all() and (pictures[0] != pictures[1]).any()
        assert len(env.get_images()) == 2
        assert env.render().ndim == 3
        assert env.env_is_wrapped(Monitor) == [False] * 3
        with pytest.raises(ValueError, match="size: must be"):
            env.env_method("render", (-1, 0), indices=0)
        env.step(np.zeros((3, 2)))  # none of that has done any harm
    finally:
        env.close()


def test_env_methods_are_called_once_a_world():
    env = TeamVecEnv(SMALL, (3,), lidar=COMPACT, random_clocks=False)
    env.reset()
    env.env_method("decide", np.zeros((3, 2), np.float32))
    assert env.get_attr("decisions") == [1, 1, 1]


def test_wrappers_of_sb3_go_round_it():
    env = TeamVecEnv(SMALL, (1, 2), lidar=COMPACT, critic="world", random_clocks=False)
    wrapped = VecMonitor(VecNormalize(env, norm_obs=False, gamma=0.9))
    wrapped.reset()
    for _ in range(12):
        observation, rewards, dones, infos = wrapped.step(np.zeros((3, 2)))
    assert dones.all() and rewards.dtype == np.float32
    assert set(infos[0]["terminal_observation"]) == set(observation) == {"lidar", "critic"}
    assert infos[2]["episode"]["l"] == 12


@pytest.mark.parametrize(("n_workers", "seen"), [(0, "own"), (2, "world")])
def test_ppo_trains_on_it_without_a_warning(n_workers, seen):
    lidar = Lidar(sectors=64, frame="goal")
    env = TeamVecEnv(SMALL, (1, 2, 3), lidar=lidar, critic=seen, credit="own", n_workers=n_workers)
    try:
        model = PPO("MultiInputPolicy", VecNormalize(env, norm_obs=False), n_steps=20, batch_size=60, device="cpu")
        model.learn(240)
        assert model.num_timesteps == 240
        assert len(model.ep_info_buffer) > 0
    finally:
        env.close()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"scenario": "desert"}, "scenario: 'desert' is neither"),
        ({"team_sizes": ()}, "team_sizes: needs one number or more"),
        ({"team_sizes": 3}, r"team_sizes: needs one number or more, one a world \(given: 3\)"),
        ({"team_sizes": (2, 0)}, r"team_sizes\[1\]: needs a whole number, 1 or more \(given: 0\)"),
        ({"decision_interval": 0}, "decision_interval: needs a whole number, 1 or more"),
        ({"decision_interval": 2.5}, r"decision_interval: .*\(given: 2.5\)"),
        ({"n_workers": -1}, "n_workers: needs a whole number, 0 or more"),
        ({"seed": -1}, "seed: needs a whole number, 0 or more"),
        ({"credit": "mine"}, "credit: 'mine' is not one of 'team', 'own'"),
        ({"critic": "all"}, "critic: 'all' is not one of 'own', 'world'"),
        ({"render_mode": "human"}, "render_mode: 'human' is not one of None, 'rgb_array'"),
        ({"lidar": "radar"}, r"lidar: needs a Lidar or None \(given: 'radar'\)"),
        ({"rewards": "wool"}, "rewards: 'wool' is not one of original, any, wild"),
        ({"rewards": {"f": (1.0, lambda *_: 0.0)}, "n_workers": 1}, "scenario, rewards: cannot be sent to workers"),
    ],
)
def test_bad_arguments(arguments, message):
    with pytest.raises(SettingsError, match=message):
        TeamVecEnv(**{"scenario": SMALL, **arguments})


def test_a_step_that_failed_is_not_made_twice():
    env = TeamVecEnv(SMALL, (1, 1), lidar=COMPACT, rewards={"fails": (1.0, Fails(1))})
    env.reset()
    with pytest.raises(ValueError, match="the wolf"):
        env.step(np.zeros((2, 2)))
    for call in (env.step_wait, lambda: env.step(np.zeros((2, 2)))):
        with pytest.raises(RuntimeError, match="call"):
            call()
    env.reset()
    assert env.get_attr("decisions") == [0, 0]


def test_bad_actions_and_calls_out_of_turn():
    env = TeamVecEnv(SMALL, (2,), lidar=COMPACT)
    with pytest.raises(RuntimeError, match="call reset first"):
        env.step(np.zeros((2, 2)))
    with pytest.raises(RuntimeError, match="call step_async first"):
        env.step_wait()
    env.reset()
    with pytest.raises(ValueError, match=r"actions: needs shape \(2, 2\)"):
        env.step(np.zeros((3, 2)))
    with pytest.raises(ValueError, match="actions: every number must be finite"):
        env.step(np.array([[0.0, np.nan], [0.0, 0.0]]))
    env.step_async(np.zeros((2, 2)))
    with pytest.raises(RuntimeError, match="a step is under way"):
        env.step_async(np.zeros((2, 2)))
    with pytest.raises(RuntimeError, match="a step is under way"):
        env.get_attr("index")
    env.step_wait()
    env.step_async(np.zeros((2, 2)))
    env.reset()
    assert env.get_attr("decisions") == [0, 0]
    with pytest.raises(SettingsError, match=r"scenario: the function must give a Scenario \(given: 'meadow'\)"):
        TeamVecEnv(no_scenario, (2,)).reset()


def test_presets_work_as_scenarios():
    env = TeamVecEnv("small", (2,), lidar=COMPACT)
    env.reset()
    assert env.get_attr("scenario", 0) == [SCENARIOS["small"]]


def no_room(rng, site):
    raise PlacementError("no room")


class Crowded:
    """A meadow with no room but in every third draw."""

    def __init__(self, room=3):
        self.room, self.drawn = room, 0

    def __call__(self, rng, index):
        self.drawn += 1
        return SMALL if self.room and self.drawn % self.room == 0 else SMALL.but(layout=no_room)


def test_a_draw_that_finds_no_room_is_drawn_again():
    draw = Crowded()
    env = TeamVecEnv(draw, (2,), lidar=COMPACT, random_clocks=False)
    env.reset()
    assert (draw.drawn, env.get_attr("scenario")) == (3, [SMALL] * 2)
    for _ in range(SMALL.n_steps):
        env.step(np.zeros((2, 2)))
    assert (draw.drawn, env.get_attr("decisions")) == (6, [0] * 2)
    with pytest.raises(SettingsError, match="no room"):
        TeamVecEnv(Crowded(room=0), (2,), lidar=COMPACT).reset()
