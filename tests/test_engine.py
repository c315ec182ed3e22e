"""The compiled loop of engine steps does bit for bit what pymunk's public functions do."""

import numpy as np
import pymunk
import pytest

from shepherd_phys import _engine
from shepherd_phys.bodies import Disc
from shepherd_phys.obstacles import Pillar, Wall
from shepherd_phys.scenario import Scenario
from shepherd_phys.world import World

OPEN = Scenario(n_sheep=30, n_flocks=2, shepherds=4)
CROWDED = OPEN.but(box=14.0, obstacles=(Wall(start=(-8.0, 3.0), end=(8.0, 3.0)), Pillar(center=(0.0, -3.0))))


class Spinning(Disc):
    """A body that is read with its angle."""

    def build(self):
        body = pymunk.Body(self.mass, 0.2)
        return body, [pymunk.Poly.create_box(body, (0.5, 0.3))]

    def follow(self, pose, wanted, dt):
        return wanted * np.cos(pose[2]), 0.5


def episode(scenario, n_steps=120):
    """Bytes of every state while the shepherds run into one another, and the contacts that were counted."""
    world = World(scenario)
    state = world.reset(3)
    seen = []
    for step in range(n_steps):
        middle = state.shepherd_pos.mean(axis=0) if step % 60 < 30 else state.sheep_pos.mean(axis=0)
        state = world.step(middle - state.shepherd_pos)
        seen.append((state.sheep_pos.tobytes(), state.shepherd_vel.tobytes(), state.collisions))
    return seen


@pytest.mark.parametrize(
    "scenario",
    [OPEN, CROWDED, OPEN.but(substeps=1), OPEN.but(shepherds=(Spinning(), Disc()))],
    ids=["open", "crowded", "one substep", "spinning"],
)
def test_both_ways_through_the_engine_are_one(scenario, monkeypatch):
    direct = episode(scenario)
    assert direct[-1][-1] > 0  # Python was called back from within the compiled loop

    def gone(self):
        raise AttributeError("no such private name")

    steps = []
    step = _engine.Engine.step
    monkeypatch.setattr(_engine.Engine, "step", lambda self, h: steps.append(h) or step(self, h))
    monkeypatch.setattr(_engine.Engine, "_bound", gone)
    assert episode(scenario) == direct
    assert len(steps) == 120 * scenario.n_substeps


def test_the_usual_step_is_direct(monkeypatch):
    """Only the first step goes through pymunk, which looks at bodies that are new to it."""
    steps = []
    monkeypatch.setattr(pymunk.Space, "step", lambda self, h, step=pymunk.Space.step: steps.append(h) or step(self, h))
    episode(OPEN, 5)
    assert len(steps) == OPEN.n_substeps


def test_what_pymunk_does_besides_stepping_is_left_to_it():
    """A callback of somebody else's may ask for anything: then every engine step is pymunk's own."""
    world = World(OPEN)
    world.reset(0)
    world.step(np.zeros((4, 2)))
    done = []
    world.space.on_collision(77, 78, begin=lambda arbiter, space, data: None)
    world.space._locked = True  # as in a callback
    world.space.add_post_step_callback(lambda space, key: done.append(key), "late")
    world.space._locked = False
    world.step(np.zeros((4, 2)))
    assert done == ["late"]


def test_a_step_that_was_put_in_the_place_of_the_spaces_own_is_taken():
    world = World(OPEN)
    world.reset(0)
    world.step(np.zeros((4, 2)))
    steps = []
    own = world.space.step
    world.space.step = lambda h: steps.append(h) or own(h)
    world.step(np.zeros((4, 2)))
    assert len(steps) == OPEN.n_substeps


def test_bodies_that_went_are_noticed():
    world = World(OPEN)
    world.reset(0)
    world.step(np.zeros((4, 2)))
    *_, body = world.space.bodies
    world.space.remove(*body.shapes, body)
    for _ in range(2):
        with pytest.raises(RuntimeError, match="bodies were added to the world's space, or removed"):
            world.step(np.zeros((4, 2)))
