"""What a shepherd does whose policy gets it nowhere."""

import numpy as np
import pytest
from test_hold import AROUND, HOME, LIDAR, frames
from test_learned import SMALL, random_weights, spec_of

from shepherd_phys.controllers import Policy
from shepherd_phys.controllers.policy_files import PolicyError
from shepherd_phys.controllers.wander import Wander, Wanderer
from shepherd_phys.lidar import Lidar
from shepherd_phys.scenario import Scenario
from shepherd_phys.settings import SettingsError
from shepherd_phys.world import World

NOBODY = np.zeros(3, np.bool_)
QUICK = Wander(memory=0.1, least=0.2, after=3, shortest=2, longest=4)
# one stands, one goes to and fro, one gets on
TEAM = np.array([[[0.0, 0.0], [way, 0.0], [0.6, 0.6]] for way in (0.9, -0.9) * 20])


def walked(settings=QUICK, holds=NOBODY, seed=0):
    """What the team does, (steps, P, 2)."""
    wanderer = Wanderer(settings, np.random.default_rng(seed))
    return np.array([wanderer(wanted, holds) for wanted in TEAM])


def test_who_gets_nowhere_walks_at_random_for_a_while():
    done = walked()
    other = np.any(done != TEAM, axis=2)
    # the second one's mean begins at 0.9 and falls by a tenth of the rest at each step
    assert not other[:2].any() and other[2, 0] and not other[:, 2].any()
    assert not other[:8, 1].any() and other[:, 1].any()
    np.testing.assert_allclose(np.hypot(*done[other].T), 1.0)
    # each walk is straight, 2 to 4 steps long, and another than the one before
    ways = done[:, 0][other[:, 0]]
    turns = np.flatnonzero(np.any(np.diff(ways, axis=0) != 0, axis=1)) + 1
    lengths = np.diff([0, *turns, len(ways)])
    assert len(turns) >= 5 and set(lengths[:-1]) <= {2, 3, 4} and len(set(lengths[:-1])) > 1


def test_who_sees_the_herd_home_stays():
    done = walked(holds=np.array([True, False, False]))
    np.testing.assert_array_equal(done[:, 0], TEAM[:, 0])
    assert np.any(done[:, 1] != TEAM[:, 1])


def test_a_walk_ends_where_the_herd_is_seen_home_and_the_patience_begins_anew():
    wanderer = Wanderer(QUICK, np.random.default_rng(0))
    still, home, out = np.zeros((1, 2)), np.ones(1, np.bool_), np.zeros(1, np.bool_)
    seen = [out] * 3 + [home] * 2 + [out] * 3
    moves = [bool(wanderer(still, now).any()) for now in seen]
    assert moves == [False, False, True, False, False, False, False, True]  # walks take two decisions at least


def test_walks_are_a_function_of_the_episodes_seed():
    np.testing.assert_array_equal(walked(seed=3), walked(seed=3))
    assert np.any(walked(seed=3) != walked(seed=4))


def test_a_policy_wanders_where_its_team_is_stuck_and_not_where_the_herd_is_home():
    weights = random_weights(SMALL, LIDAR)
    weights["action.weight"] *= 0.0
    weights["action.bias"] *= 0.0
    policy = Policy(spec_of(LIDAR, wander=Wander(after=4)), weights)
    state = World(Scenario()).reset(0)

    def acts(sheep, seed=0):
        seen = frames(sheep, AROUND)[0].reshape(3, -1, LIDAR.beams)
        policy.reset(np.random.default_rng(seed))
        return np.array([policy.act(seen, state) for _ in range(8)])

    assert not acts(HOME).any()
    stuck = acts((*HOME, (0.0, -20.0)))
    assert not stuck[:3].any() and np.hypot(*stuck[3:].reshape(-1, 2).T) == pytest.approx(1.0)
    np.testing.assert_array_equal(stuck, acts((*HOME, (0.0, -20.0))))
    policy = Policy(spec_of(LIDAR, wander=Wander(after=4, home=2.0)), weights)
    assert acts(HOME).any()  # one of them is 2.7 m from the border


def test_wrong_settings_are_refused():
    with pytest.raises(SettingsError, match=r"Wander: longest: must be at least shortest, 9 \(given: 3\)"):
        Wander(shortest=9, longest=3)
    with pytest.raises(PolicyError, match=r"action.wander: needs the frame 'goal' and the channel of sheep"):
        spec_of(Lidar(), wander=Wander())
