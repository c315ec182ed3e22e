"""Networks, export and learning: torch and numpy agree; the actor sees its lidar alone; a NaN is named."""

import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3 import PPO
from test_learned import LIDAR, SMALL, random_weights, spec_of

from shepherd_phys.bodies import Unicycle
from shepherd_phys.controllers import Policy, load_policy
from shepherd_phys.controllers.hold import Hold
from shepherd_phys.controllers.network import Actor, SectorNetwork, input_shape
from shepherd_phys.controllers.policy_files import Acting, PolicyError
from shepherd_phys.controllers.wander import Wander
from shepherd_phys.envs.rewards import SCHEMES, Effort
from shepherd_phys.envs.team import TeamVecEnv
from shepherd_phys.flock import Reynolds
from shepherd_phys.imperfections import Imperfections
from shepherd_phys.layouts import Scattered
from shepherd_phys.learning.export import actor_weights, load_actor, to_policy, to_sb3
from shepherd_phys.learning.export import spec_of as spec_of_preset
from shepherd_phys.learning.network import TeamPolicy
from shepherd_phys.learning.parts import CriticNetwork, PPOSettings, Validation
from shepherd_phys.learning.ppo import Learner, TrainingError
from shepherd_phys.learning.preset import PRESETS, Preset, load_preset
from shepherd_phys.learning.validation import Validator
from shepherd_phys.lidar import CHANNELS, Lidar
from shepherd_phys.obstacles import Pillar
from shepherd_phys.scenario import SCENARIOS
from shepherd_phys.settings import SettingsError

TINY = Preset(
    scenario=SCENARIOS["small"].but(n_steps=40),
    worlds=2,
    team_sizes=(1, 2),
    lidar=LIDAR,
    network=SMALL,
    critic=CriticNetwork(world=6, hidden=8, latent=5),
    ppo=PPOSettings(n_steps=8, batch_size=12, n_epochs=2),
    validation=Validation(flocks=(1,), trials=1, shepherds=(2,)),
    checkpoint_rollouts=2,
    budget=360,
)


@pytest.fixture
def learner():
    made = Learner(TINY)
    made.restart(0)
    yield made
    made.close()


def policy_of(lidar, network, critic_numbers=0, seed=0):
    torch.manual_seed(seed)
    seen = {"lidar": spaces.Box(0.0, 1.0, input_shape(lidar), np.float32)}
    if critic_numbers:
        seen["critic"] = spaces.Box(-np.inf, np.inf, (critic_numbers,), np.float32)
    return TeamPolicy(
        spaces.Dict(seen), spaces.Box(-1.0, 1.0, (2,), np.float32), lambda _: 1e-3, network=network, critic=None
    )


CASES = {
    "fast": (Lidar(sectors=64, frame="goal"), SectorNetwork()),
    "fast, overlapping": (Lidar(sectors=64, frame="goal"), SectorNetwork(overlap=3)),
    "paper": (Lidar(), SectorNetwork(group=8)),
    "four channels": (Lidar(channels=("sheep", "shepherds", "goal", "obstacles"), sectors=64), SectorNetwork()),
}


@pytest.mark.parametrize("name", CASES)
def test_torch_and_numpy_agree(name, tmp_path):
    lidar, network = CASES[name]
    policy = policy_of(lidar, network)
    with torch.no_grad():
        for parameter in policy.parameters():  # the last layer begins near 0, which would hide a difference
            parameter.add_(0.02 * torch.randn_like(parameter))
    rng = np.random.default_rng(1)
    shape = (50, *input_shape(lidar))
    observation = rng.random(shape, dtype=np.float32) * (rng.random(shape) < rng.random((50, 1, 1)))
    with torch.no_grad():
        wanted_of = policy.get_distribution({"lidar": torch.from_numpy(observation)})
        wanted, deviation = wanted_of.mode().numpy(), wanted_of.distribution.stddev.numpy()
    assert np.abs(wanted).max() > 0.1
    exported = to_policy(policy, spec_of(lidar, network), tmp_path / "p.json")
    actor = Actor(network, lidar, exported.weights)
    assert actor(observation) == pytest.approx(wanted, abs=1e-5)
    assert np.broadcast_to(actor.deviation, deviation.shape) == pytest.approx(deviation, abs=1e-5)
    back = to_sb3(load_policy(tmp_path / "p.json"), critic_numbers=7)
    action, _ = back.predict({"lidar": observation, "critic": np.zeros((50, 7), np.float32)}, deterministic=True)
    assert action == pytest.approx(np.clip(wanted, -1, 1), abs=1e-5)  # sums in another order


def test_the_actor_sees_its_lidar_alone_and_the_critic_the_world():
    policy = policy_of(LIDAR, SMALL, critic_numbers=4)
    observation = {
        "lidar": torch.rand((3, 6, 16)),
        "critic": torch.rand((3, 4)),
    }
    other = {**observation, "critic": torch.rand((3, 4))}
    with torch.no_grad():
        assert torch.equal(policy.get_distribution(observation).mode(), policy.get_distribution(other).mode())
        assert not torch.equal(policy.predict_values(observation), policy.predict_values(other))
    actor = set(actor_weights(policy))
    assert actor == set(SMALL.shapes(LIDAR))


def test_features_made_together_are_those_made_apart():
    """Learning cuts the lidar once for actor and critic; stable-baselines3 asks for either alone, too."""
    policy = policy_of(LIDAR, SMALL.but(overlap=2), critic_numbers=4)
    observation = {"lidar": torch.rand((3, 6, 16)), "critic": torch.rand((3, 4))}
    with torch.no_grad():
        for parameter in policy.parameters():  # the last layers begin near 0, which would hide a difference
            parameter.add_(0.1 * torch.randn_like(parameter))
        alone, value = policy.get_distribution(observation), policy.predict_values(observation)
        actions, values, log_prob = policy(observation)
        again, log_prob_again, entropy = policy.evaluate_actions(observation, actions)
    assert torch.equal(values, value) and torch.equal(again, value)
    assert torch.equal(log_prob, alone.log_prob(actions)) and torch.equal(log_prob_again, log_prob)
    assert torch.equal(entropy, alone.entropy())
    assert np.ptp(value.numpy()) > 1e-3


def test_actor_and_critic_share_no_weight():
    policy = policy_of(LIDAR, SMALL)
    observation = {"lidar": torch.rand((3, 6, 16))}
    before = policy.predict_values(observation)
    load_actor(policy, random_weights(SMALL, LIDAR, seed=9))
    assert torch.equal(before, policy.predict_values(observation))


def test_weights_begin_orthogonal_and_actions_small():
    policy = policy_of(Lidar(sectors=64, frame="goal"), SectorNetwork())
    weights = actor_weights(policy)
    hidden = weights["hidden.weight"]
    assert hidden @ hidden.T == pytest.approx(2 * np.eye(192), abs=1e-4)
    assert np.linalg.norm(weights["action.weight"], axis=1) == pytest.approx(0.01, rel=1e-3)


def test_only_a_model_of_the_right_sizes_becomes_a_policy():
    with pytest.raises(PolicyError, match=r"hidden.weight: must be float32 \(7, 20\) \(given: float32 \(9, 20\)\)"):
        to_policy(policy_of(LIDAR, SMALL.but(hidden=9)), spec_of())
    env = TeamVecEnv(TINY.scenario, (1,), lidar=LIDAR)
    with pytest.raises(PolicyError, match="only a TeamPolicy.*MultiInputActorCriticPolicy"):
        to_policy(PPO("MultiInputPolicy", env, n_steps=4, batch_size=4), spec_of())
    env.close()
    with pytest.raises(PolicyError, match="of another size"):
        load_actor(policy_of(LIDAR, SMALL), random_weights(SMALL.but(hidden=9), LIDAR))
    weights = random_weights(SMALL, LIDAR)
    with pytest.raises(PolicyError, match=r"moon\.weight: is no weight of the network"):
        load_actor(policy_of(LIDAR, SMALL), {**weights, "moon.weight": weights["log_std"]})
    with pytest.raises(PolicyError, match="log_std: is missing"):
        load_actor(policy_of(LIDAR, SMALL), {name: array for name, array in weights.items() if name != "log_std"})


def test_state_dependent_exploration_is_refused():
    env = TeamVecEnv(TINY.scenario, (1,), lidar=LIDAR)
    with pytest.raises(SettingsError, match=r"^use_sde: .*given: True"):
        PPO(TeamPolicy, env, use_sde=True, n_steps=4, batch_size=4, policy_kwargs={"network": SMALL})
    env.close()


def test_a_model_whose_weights_have_other_names_is_refused(monkeypatch):
    policy = policy_of(LIDAR, SMALL)
    weights = actor_weights(policy)
    for wrong in ({**weights, "moon.weight": weights["log_std"]}, {"log_std": weights["log_std"]}):
        monkeypatch.setattr("shepherd_phys.learning.export.actor_weights", lambda _, wrong=wrong: wrong)
        with pytest.raises(PolicyError, match="unknown weight .moon.weight.|no weight .groups.weight."):
            to_policy(policy, spec_of())


def test_a_live_model_is_exported_and_goes_on(learner, tmp_path):
    """Export to a file, and back into a plain PPO of stable-baselines3 that learns on."""
    policy = to_policy(learner.model, spec_of_preset(TINY, 5), tmp_path / "p.json")
    assert policy.checksum == load_policy(tmp_path / "p.json").checksum
    assert policy.spec.training["shepherd_steps"] == 5
    assert policy.spec.rewards["terms"]["occlude"]["weight"] == 0.1
    sizes = {"network": SMALL, "critic": TINY.critic}
    model = PPO(TeamPolicy, learner.env, n_steps=8, batch_size=12, policy_kwargs=sizes, seed=3)
    load_actor(model.policy, policy.weights)
    np.testing.assert_array_equal(actor_weights(model.policy)["hidden.weight"], policy.weights["hidden.weight"])
    model.learn(24)
    assert not np.array_equal(actor_weights(model.policy)["hidden.weight"], policy.weights["hidden.weight"])


# ------------------------------------------------------------------- learning


def test_a_rollout_changes_everything_and_measures_whole_episodes(learner):
    before = learner.state()[0]
    found = [learner.learn() for _ in range(3)]
    after, facts = learner.state()
    for name in before:
        assert not np.array_equal(before[name], after[name]), name
    assert {name for name in after if name.startswith("adam/")}
    assert facts["rollouts"] == 3 and facts["decisions"] == 3 * 8 * 3
    assert facts["shepherd_steps"] == learner.env.shepherd_steps
    # 24 decisions in each of two worlds; whole episodes are of 8, and the first ones began at a random clock
    assert 2 * 2 <= sum(one["episodes"] for one in found) <= 2 * 3
    for one in found:
        assert np.isfinite(one["value_loss"])
        assert np.isfinite(one["episode_reward"]) == (one["episodes"] > 0)


def test_the_learning_rate_falls_over_the_budget():
    learner = Learner(TINY.but(ppo=TINY.ppo.but(learning_rate=4e-3, last_learning_rate=1e-3), budget=300))
    learner.restart(0)
    for _ in range(4):
        learner.learn()
        expected = 4e-3 - 3e-3 * min(learner.shepherd_steps / 300, 1.0)
        assert learner.policy.optimizer.param_groups[0]["lr"] == pytest.approx(expected)
    assert expected == 1e-3
    learner.close()


def test_exploration_is_limited_by_a_line():
    learner = Learner(TINY.but(ppo=TINY.ppo.but(log_std_init=-0.5, last_log_std=-2.5, last_log_std_at=200)))
    learner.restart(0)
    for limit in (-0.5, -0.5 - 2.0 * 120 / 200, -2.5, -2.5):
        steps = learner.shepherd_steps
        assert limit == pytest.approx(
            max(-2.5, -0.5 - 2.0 * steps / 200), abs=0.3
        )  # a few steps fewer at episodes' ends
        with torch.no_grad():
            learner.policy.log_std[0] = 0.9  # as if it had been learned
            learner.policy.log_std[1] = -3.0
        learner._limit_exploration()
        first, second = learner.policy.log_std.tolist()
        assert first == pytest.approx(-0.5 - 2.0 * min(steps / 200, 1.0)) and second == -3.0  # less is left alone
        learner.learn()
    learner.close()


def test_at_first_only_the_critic_learns(tmp_path):
    to_policy(policy_of(LIDAR, SMALL, seed=4), spec_of_preset(TINY), tmp_path / "p.json")
    learner = Learner(TINY.but(init=str(tmp_path / "p.json"), critic_first=1))
    learner.restart(0)
    actor = load_policy(tmp_path / "p.json").weights
    critic = learner.policy.value_net.weight.detach().clone()
    learner.learn()
    for name, array in actor_weights(learner.policy).items():
        np.testing.assert_array_equal(array, np.full(2, -0.3, np.float32) if name == "log_std" else actor[name])
    assert not torch.equal(critic, learner.policy.value_net.weight)
    learner.learn()
    for name, array in actor_weights(learner.policy).items():
        assert not np.array_equal(array, actor[name]), name
    learner.close()


def test_a_policy_to_start_from_must_fit(tmp_path):
    to_policy(policy_of(LIDAR, SMALL), spec_of_preset(TINY), tmp_path / "p.json")
    with pytest.raises(SettingsError, match="init: .* has another network"):
        Learner(TINY.but(init=str(tmp_path / "p.json"), network=SMALL.but(latent=9)))
    with pytest.raises(PolicyError, match="cannot be read"):
        Learner(TINY.but(init=str(tmp_path / "q.json")))


def test_a_policy_that_never_saw_obstacles_may_learn_about_them(tmp_path):
    to_policy(policy_of(LIDAR, SMALL, seed=4), spec_of_preset(TINY), tmp_path / "p.json")
    known = LIDAR.channels
    preset = TINY.but(scenario=TINY.scenario.but(layout=Scattered(count=2)), init=str(tmp_path / "p.json"))
    assert preset.lidar.channels == (*known, "obstacles")
    weights = preset.start()
    old, new = Actor(SMALL, LIDAR, load_policy(tmp_path / "p.json").weights), Actor(SMALL, preset.lidar, weights)
    rng = np.random.default_rng(0)
    rows, columns = input_shape(preset.lidar)
    seen = rng.random((5, rows, columns)).astype(np.float32)
    without = seen.reshape(5, LIDAR.stack, len(known) + 1, columns)[:, :, : len(known)].reshape(5, -1, columns)
    np.testing.assert_allclose(new(seen), old(without), rtol=1e-5, atol=1e-6)
    learner = Learner(preset)
    np.testing.assert_array_equal(actor_weights(learner.policy)["groups.weight"], weights["groups.weight"])
    learner.close()
    # and not the other way round
    to_policy(policy_of(preset.lidar, SMALL), spec_of_preset(preset), tmp_path / "q.json")
    with pytest.raises(
        SettingsError, match=r"init: .*q.json has another lidar .* cannot become .* by further channels"
    ):
        Learner(TINY.but(init=str(tmp_path / "q.json")))


def test_a_preset_may_learn_in_several_scenarios():
    preset = TINY.but(scenarios=("paper", "scattered"), density=(0.0, 0.02))
    kinds = {preset.draw()(np.random.default_rng(k), 0).layout is None for k in range(30)}
    assert kinds == {True, False}
    assert Preset.from_dict(preset.to_dict()) == preset
    alike = TINY.scenario.but(imperfections=Imperfections(lost_beams=0.1), shepherds=(Unicycle(),))
    shared = preset.but(scenario=alike).draw()
    for drawn in (shared(np.random.default_rng(k), 0) for k in range(10)):
        assert (drawn.imperfections, drawn.shepherds) == (alike.imperfections, alike.shepherds)
        assert drawn.flock == alike.flock
    with pytest.raises(SettingsError, match="scenarios: 'moon' is not one of"):
        TINY.but(scenarios=("moon",))
    with pytest.raises(SettingsError, match="density: no base scatters"):
        TINY.but(density=(0.0, 0.02))


@pytest.mark.parametrize("where", ["rewards", "lidar", "critic"])
def test_a_nan_of_the_worlds_is_named(where, learner, monkeypatch):
    step = learner.env.step_wait

    def broken():
        observation, rewards, dones, infos = step()
        (rewards if where == "rewards" else observation[where])[1] = np.nan
        return observation, rewards, dones, infos

    monkeypatch.setattr(learner.env, "step_wait", broken)
    with pytest.raises(TrainingError, match=where):
        learner.learn()


def test_a_nan_at_the_beginning_is_named(learner, monkeypatch):
    restart = learner.env.restart

    def broken(number):
        observation = restart(number)
        observation["lidar"][1] = np.nan
        return observation

    monkeypatch.setattr(learner.env, "restart", broken)
    with pytest.raises(TrainingError, match="observation 'lidar': holds a NaN"):
        learner.restart(1)


@pytest.mark.parametrize(
    ("notes", "raised", "said"),
    [
        ((), TrainingError, "^learning failed: the wolf came$"),
        (("in world 0",), ValueError, "^the wolf came\nin world 0$"),
    ],
)
def test_a_users_value_error_is_not_taken_for_learnings(notes, raised, said, learner, monkeypatch):
    """Those of a world say in which; without that it is torch's, which a NaN has upset."""

    def broken():
        error = ValueError("the wolf came")
        for note in notes:
            error.add_note(note)
        raise error

    monkeypatch.setattr(learner.env, "step_wait", broken)
    with pytest.raises(raised, match=said):
        learner.learn()


def test_a_nan_of_the_network_is_named(learner):
    with torch.no_grad():
        learner.policy.pi_features_extractor.hidden.weight[0, 0] = np.inf
    with pytest.raises(TrainingError, match=r"features_extractor\.hidden\.weight"):
        learner.learn()


def test_a_nan_of_the_loss_is_named(learner, monkeypatch):
    learn = learner.model.learn

    def broken(*args, **options):
        learn(*args, **options)
        learner.model.logger.record("train/value_loss", np.nan)

    monkeypatch.setattr(learner.model, "learn", broken)
    with pytest.raises(TrainingError, match="train/value_loss is nan"):
        learner.learn()


def test_validation_is_an_evaluation_on_its_own_seeds_and_disturbs_nothing(learner):
    policy = to_policy(learner.model, spec_of_preset(TINY))
    state = torch.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002 (stable-baselines3 draws from it)
    validator = Validator(TINY.but(validation=Validation(flocks=(1, 2), cohesion=(5, 8), shepherds=(2,), trials=2)))
    rows = validator(policy)
    assert [(row["n_flocks"], row["cohesion"], row["n_shepherds"]) for row in rows] == [
        (1, 5, 2), (1, 8, 2), (2, 5, 2), (2, 8, 2),
    ]  # fmt: skip
    assert validator(policy) == rows
    assert torch.equal(torch.get_rng_state(), state[0])
    assert np.array_equal(np.random.get_state()[1], state[1])  # noqa: NPY002
    boids = TINY.but(scenario=TINY.scenario.but(flock=Reynolds()), validation=Validation(flocks=(1,), cohesion=(5, 8)))
    assert Validator(boids).points == [{"n_flocks": 1, "cohesion": None, "n_shepherds": 3}]
    rows = [{"in_goal_end": 90.0, "path_length": 200.0}, {"in_goal_end": 100.0, "path_length": 100.0}]
    assert validator.score(rows) == 95.0
    costly = Validator(TINY.but(validation=TINY.validation.but(path_cost=0.1)))
    assert costly.score(rows) == pytest.approx(80.0)


# ------------------------------------------------------------------- presets


def test_presets_are_read_and_written(tmp_path):
    assert {"fast", "paper", "collie"} <= set(PRESETS)
    for name in PRESETS:
        preset = load_preset(name)
        preset.to_toml(tmp_path / "p.toml")
        assert load_preset(tmp_path / "p.toml") == preset
    TINY.to_toml(tmp_path / "p.toml")
    assert load_preset(tmp_path / "p.toml") == TINY
    assert load_preset("fast").but(budget=1) == Preset(budget=1, wander=Wander())


def test_the_papers_preset_is_the_papers():
    paper = load_preset("paper")
    assert paper.lidar == Lidar() and paper.lidar.observation_shape(1) == (1, 9, 512)
    assert (paper.decision_interval, paper.credit, paper.critic_sees) == (1, "team", "own")
    assert (paper.budget, paper.scenario, set(paper.sizes)) == (300_000_000, SCENARIOS["paper"], {1, 2, 3, 4, 5, 6})
    assert paper.scheme()["distance"][1].norm == "NT" and not paper.effort


def test_a_preset_may_mix_worlds_and_price_effort():
    preset = TINY.but(n_flocks=(1, 3), effort=2.0, gathered=3.0, worlds=5, team_sizes=(3, 1))
    assert preset.sizes == (3, 1, 3, 1, 3) and preset.n_slots == 11
    drawn = preset.draw()(np.random.default_rng(0), 0)
    assert 1 <= drawn.n_flocks <= 3 and drawn.flock == TINY.scenario.flock
    assert preset.scheme()["effort"] == (-2.0, Effort())
    assert preset.but(effort_team=3).scheme()["effort"] == (-2.0, Effort(team=3))
    assert preset.scheme()["gathered"][0] == 3.0
    with pytest.raises(SettingsError, match="effort: the reward has a term of this name already"):
        preset.but(reward={**SCHEMES["wild"], "effort": (-0.5, Effort())})
    assert set(TINY.scheme()) == set(SCHEMES["wild"])
    spec = spec_of_preset(TINY.but(rest=0.25, noise=0.5))
    assert spec.action == Acting(frame="goal", rest=0.25, noise=0.5, noise_steps=TINY.decision_interval)
    assert spec_of_preset(TINY.but(noise=0.0)).action == Acting(frame="goal", noise_steps=TINY.decision_interval)
    assert spec_of_preset(TINY.but(mirror="left")).action.mirror == "left"
    assert spec_of_preset(TINY.but(mirror="left")).training["learns_mirrored"] is False
    assert spec_of_preset(TINY.but(hold=Hold(ring=9.0))).action.hold == Hold(ring=9.0)
    wanders = spec_of_preset(TINY.but(hold=Hold(), wander=Wander()))
    assert wanders.action.wander == Wander()
    assert not {"rest", "noise", "mirror", "hold", "wander"} & set(wanders.training)
    far = TINY.but(flock_distance=(4.0, 5.0), uneven=1.0).draw()(np.random.default_rng(0), 0)
    assert far.flock_distance == (4.0, 5.0) and far.flock_sizes is not None and far.n_flocks == TINY.scenario.n_flocks
    assert TINY.but(flock_distance=(4.0, 5.0)).draw() == TINY.scenario.but(flock_distance=(4.0, 5.0))
    most = TINY.but(n_sheep=(TINY.scenario.n_sheep, TINY.scenario.n_sheep + 9)).draw()
    assert {most(np.random.default_rng(k), 0).n_sheep - TINY.scenario.n_sheep for k in range(200)} == set(range(10))
    assert TINY.draw() == TINY.scenario


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("reward = 'wold'", "'wold' is not one of original, any, wild"),
        ("rewards = 'wild'", "rewards: there is no such field .*did you mean reward.;? "),
        (
            "n_steps = 3",
            "Preset.n_steps: there is no such field .given: 3.; did you mean scenario.n_steps or ppo.n_steps.;? ",
        ),
        ("decision_interval = 1001", "decision_interval.*less than or equal to 1000"),
        ("budget = 0", "budget.*greater than or equal to 1"),
        ("team_sizes = []", "team_sizes"),
        ("team_sizes = [0]", "team_sizes"),
        ("critic_first = 3", "critic_first: makes sense only with init"),
        ("learns_mirrored = true", "learns_mirrored: makes sense only with a mirror"),
        ("hold = 3", "Preset.hold: .*a dictionary.*given: 3"),
        ("[wander]\n[lidar]\nframe = 'world'", "wander: needs the frame 'goal'"),
        ("[hold]\nring = 0", "Preset.hold.ring: .*greater than 0"),
        ("[hold]\n[lidar]\nframe = 'world'", "hold: needs the frame 'goal'"),
        ("reward = 'original'\nalpha = 1.0", "alpha: the reward 'original' has no occlusion term"),
        ("lidar = 3", "Preset.lidar: .*a dictionary.*given: 3"),
        ("scenario = 3", "Preset.scenario: .*a dictionary.*given: 3"),
        (
            "scenario = 'scaterred'",
            "scenario: .scaterred. is neither a table nor one of .*; did you mean scattered",
        ),
        ("n_flocks = [5, 2]", "smaller number comes first"),
        ("[lidar]\nlayout = 'paper'", "takes 'rows'"),
        ("[network]\ngroup = 7", "must divide"),
        ("[network]\ndepth = 7", "Preset.network.depth: there is no such field .given: 7.; fields are group"),
        ("[ppo]\nbatch_size = 100000", "more than a rollout holds"),
        ("[ppo]\ngamma = 1.5", "gamma"),
        ("[validation]\nseed = 20000", "seed"),
        ("[scenario]\nn_sheep = 0", "n_sheep"),
        ("[scenario]\nshepherds = 0", "scenario.shepherds: there must be one"),
        ("[scenario]\nflock_sizes = [60, 40]", "scenario.flock_sizes: validation has other numbers"),
        ("[scenario]\nn_sheep = 4", "validation.flocks: 5 flocks of 4 sheep cannot be"),
        ("worlds = 1_000_000_000", "worlds: Input should be less than or equal to 10000 .given: 1000000000.$"),
        ("team_sizes = [1_000_000_000]", "team_sizes.*less than or equal to 10000"),
        ("worlds = 10_000\nteam_sizes = [10_000]", "worlds, team_sizes, lidar: .* numbers of frames to remember"),
        ("[ppo]\nn_steps = 1_000_000_000", "n_steps.*less than or equal to"),
        (
            "[ppo]\nn_steps = 1_000_000",
            "worlds, team_sizes, ppo.n_steps, lidar: .* numbers observed in a rollout; at most",
        ),
        ("[scenario]\nn_sheep = 1_000_000_000", "worlds, scenario.n_sheep: 64000000000 sheep; at most"),
        ("[lidar]\nstack = 1000\nstack_stride = 1000", "lidar: .* numbers of frames to remember; a policy may have"),
        ("[network]\nhidden = 4096\nfeatures = 4096", "network: .* bytes of weights; a policy may have"),
        ("[validation]\ntrials = 1_000_000_000", "trials.*less than or equal to"),
        ("[validation]\ntrials = 1_000_000", "3 points x 1000000 trials: at most 1000000 episodes"),
        ("checkpoint_rollouts = 10_000_000_000", "checkpoint_rollouts.*less than or equal to"),
        ("seed = 100_000_000_000_000_000_000", "seed"),
        ("threads = 1_000_000", "threads.*less than or equal to"),
        ("budget =", "is not a TOML file"),
    ],
)
def test_a_wrong_preset_is_one_error(text, said, tmp_path):
    (tmp_path / "mine.toml").write_text(text)
    with pytest.raises(SettingsError, match=said) as caught:
        load_preset(tmp_path / "mine.toml")
    assert "mine.toml" in str(caught.value) and "\n" not in str(caught.value)


WALLS = "[scenario]\nobstacles = [{kind = 'Pillar', center = [8.0, 0.0], radius = 1.0}]\n"
THREE = ("sheep", "shepherds", "goal")


@pytest.mark.parametrize(
    ("lidar", "channels"),
    [("", CHANNELS), ("[lidar]\nsectors = 64", CHANNELS), (f"[lidar]\nsectors = 64\nchannels = {list(THREE)}", THREE)],
)
def test_channels_follow_from_the_scenario_unless_they_are_given(lidar, channels, tmp_path):
    (tmp_path / "mine.toml").write_text(WALLS + lidar)
    preset = load_preset(tmp_path / "mine.toml")
    assert preset.lidar.channels == channels and preset.lidar.sectors == 64
    preset.to_toml(tmp_path / "again.toml")
    assert load_preset(tmp_path / "again.toml") == preset
    (tmp_path / "mine.toml").write_text(lidar)
    assert load_preset(tmp_path / "mine.toml").lidar.channels == THREE


def test_channels_follow_from_all_scenarios_of_a_preset(tmp_path):
    assert Preset(scenarios=("paper", "fence")).lidar.channels == CHANNELS
    (tmp_path / "mine.toml").write_text('scenarios = ["corridor"]\n[lidar]\nsectors = 32\n')
    preset = load_preset(tmp_path / "mine.toml")
    assert (preset.lidar.channels, preset.lidar.sectors) == (CHANNELS, 32)
    assert preset.but(scenarios=("paper",)).lidar.channels == THREE
    assert Preset().but(scenarios=("fence",), scenario=SCENARIOS["small"]).lidar.channels == CHANNELS
    assert preset.but(lidar=Lidar(sectors=64)).but(scenarios=("fence", "paper")).lidar.channels == THREE
    for wrong in ([["fence"]], "fence", 5, None):
        with pytest.raises(SettingsError, match="scenarios"):
            Preset.from_dict({"scenarios": wrong, "lidar": {}})


def test_channels_follow_from_another_scenario():
    walled = SCENARIOS["small"].but(obstacles=(Pillar(center=(8.0, 0.0), radius=1.0),))
    assert Preset(scenario=walled).lidar == Preset().lidar.but(channels=CHANNELS)
    assert TINY.but(scenario=walled).lidar == LIDAR.but(channels=CHANNELS)
    assert TINY.but(scenario=walled).but(scenario=TINY.scenario) == TINY
    assert TINY.but(scenario=walled, lidar=LIDAR).lidar == LIDAR
    goal_alone = Lidar(channels=("sheep", "goal"), sectors=16)
    assert TINY.but(lidar=goal_alone).but(scenario=walled).lidar == goal_alone


def test_a_preset_that_is_not_there_is_one_error(tmp_path):
    with pytest.raises(SettingsError, match="neither a .toml file nor one of"):
        load_preset("fats")
    with pytest.raises(SettingsError, match="cannot be read"):
        load_preset(tmp_path / "no.toml")


def test_a_policy_that_was_trained_deploys_where_it_was_not(learner):
    """Team sizes other than those of training."""
    policy = to_policy(learner.model, spec_of_preset(TINY))
    assert isinstance(policy, Policy)
    rows = Validator(TINY.but(validation=Validation(flocks=(3,), shepherds=(1, 6), trials=1)))(policy)
    assert [row["n_shepherds"] for row in rows] == [1, 6]


def test_the_longest_decision_can_be_exported():
    assert spec_of_preset(TINY.but(decision_interval=1000)).action.noise_steps == 1000


def test_a_preset_may_have_a_reward_of_its_own(tmp_path):
    preset = TINY.but(reward={**SCHEMES["wild"], "walk": (-0.5, Effort(team=2))}, alpha=1.0)
    assert preset.reward_name == "own"
    assert preset.scheme()["walk"] == (-0.5, Effort(team=2)) and preset.scheme()["occlude"][1].alpha == 1.0
    preset.to_toml(tmp_path / "p.toml")
    assert load_preset(tmp_path / "p.toml") == preset
    assert spec_of_preset(preset).rewards["scheme"] == "own"
    foreign = Preset.from_dict({"reward": {"calm": {"weight": 1.0, "term": {"kind": "mine:calm"}}}})
    assert Preset.from_dict(foreign.to_dict()) == foreign
    with pytest.raises(SettingsError, match="'mine:calm' is a class of somebody's own and was not handed over"):
        foreign.scheme()


@pytest.mark.parametrize(
    ("reward", "said"),
    [
        ({"a": 3}, "Preset.reward.a: needs a table with weight and term"),
        ({"a": {"weight": 1.0, "term": {"kind": "Joy"}}}, "Preset.reward.a.term.kind: unknown kind 'Joy'"),
        ({"a": {"weight": "much", "term": {"kind": "Effort"}}}, "Preset.reward.*number.*given: 'much'"),
        (3, "Preset.reward.*given: 3"),
    ],
)
def test_a_reward_that_is_none_is_named(reward, said):
    with pytest.raises(SettingsError, match=said):
        Preset.from_dict({"reward": reward})
