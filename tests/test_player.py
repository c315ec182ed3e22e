"""The player of `watch`, driven by events of pygame, as its user would."""

import os
import shutil
import subprocess

import numpy as np
import pytest

from shepherd_phys.canvas import pygame_ce
from shepherd_phys.controllers.evaluation import trial_seed
from shepherd_phys.envs import ShepherdingEnv
from shepherd_phys.scenario import SCENARIOS
from shepherd_phys.scripts.player import Player
from shepherd_phys.scripts.points import Point
from shepherd_phys.scripts.sources import Live, between
from shepherd_phys.scripts.watch import run
from shepherd_phys.window import DisplayError, Window

SIZE = (200, 160)
SMALL = SCENARIOS["small"]


def make(*controllers, **options):
    sources = [Live(Point(name, "small", SMALL), 5) for name in controllers or ("strombom",)]
    return Player(sources, (SIZE[0] * len(sources), SIZE[1]), **options)


@pytest.fixture(autouse=True)
def no_display(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")


def key(name, kind="KEYDOWN"):
    pygame = pygame_ce()
    return pygame.event.Event(getattr(pygame, kind), key=pygame.key.key_code(name))


def press(player, *names):
    pygame_ce().display.init()  # key names need it
    for name in names:
        player.handle(key(name))


def mouse(player, kind, at):
    pygame = pygame_ce()
    player.handle(pygame.event.Event(getattr(pygame, kind), pos=at, button=1))


def walk(player, shepherd=0, steps=5):
    """Where a shepherd gets in so many steps, (2,) [m]."""
    before = player.views[0].now.state.shepherd_pos[shepherd]
    for _ in range(steps):
        player.tick(SMALL.control_dt / player.speed)
    return player.views[0].now.state.shepherd_pos[shepherd] - before


def test_left_alone_it_shows_the_episode_of_evaluate():
    player, env = make(), ShepherdingEnv(SMALL, rewards={}, lidar=None)
    observation, _ = env.reset(seed=trial_seed(5, 0))
    controller = type(player.views[0].source.controller)()
    controller.reset(env.user_rng)
    for _ in range(12):
        env.step(controller.act(observation, env.state))
    walk(player, steps=12)
    np.testing.assert_array_equal(player.views[0].now.state.sheep_pos, env.state.sheep_pos)
    np.testing.assert_array_equal(player.views[0].now.state.shepherd_pos, env.state.shepherd_pos)


@pytest.mark.parametrize(
    ("name", "way"), [("up", (0, 1)), ("s", (0, -1)), ("left", (-1, 0)), ("d", (1, 0))], ids=lambda x: str(x)
)
def test_keys_take_a_shepherd_over_and_give_it_back(name, way):
    led, alone = make(), make()
    press(led, name)
    assert led.taken and led.chosen == (0, 0)
    np.testing.assert_allclose(walk(led), np.array(way) * 1.5, atol=0.2)  # 1 s at 1.5 m/s; it starts
    assert np.linalg.norm(walk(alone) - np.array(way) * 1.5) > 0.1
    led.handle(key(name, "KEYUP"))
    walk(led, steps=1)  # it stops
    np.testing.assert_allclose(walk(led), 0, atol=0.01)  # nobody asks for anything: it stands, still in hand
    press(led, "g")
    assert not led.taken
    assert np.linalg.norm(walk(led)) > 0.2  # its controller leads it again


def test_two_keys_are_no_faster_than_one():
    player = make()
    press(player, "up", "right")
    assert np.linalg.norm(walk(player)) == pytest.approx(1.5, abs=0.2)


def test_the_chosen_one_is_led_and_no_other():
    led, alone = make(), make()
    press(led, "2", "up")
    assert led.chosen == (0, 1)
    other = led.views[0].now.state.shepherd_pos[1]
    walk(led, steps=1)
    walk(alone, steps=1)
    moved = led.views[0].now.state.shepherd_pos
    np.testing.assert_allclose(moved[1] - other, (0, 0.3), atol=0.2)
    np.testing.assert_allclose(moved[0], alone.views[0].now.state.shepherd_pos[0])
    press(led, "tab")
    assert led.chosen == (0, 0) and not led.taken
    press(led, "9")
    assert led.chosen == (0, 0)  # there is none


def test_the_mouse_leads_to_the_pointer():
    player = make()
    camera = player._cameras()[0]
    at = player.views[0].now.state.shepherd_pos[1]
    mouse(player, "MOUSEBUTTONDOWN", camera.to_pixels(at, SIZE))
    assert player.chosen == (0, 1) and player.taken
    np.testing.assert_allclose(walk(player, 1), 0, atol=0.05)
    target = player._cameras()[0].to_pixels(player.views[0].now.state.shepherd_pos[1] + (3.0, 0.0), SIZE)
    mouse(player, "MOUSEMOTION", target)
    assert walk(player, 1)[0] == pytest.approx(1.5, abs=0.3)
    mouse(player, "MOUSEBUTTONUP", target)
    walk(player, 1, steps=1)  # it stops
    np.testing.assert_allclose(walk(player, 1), 0, atol=0.05)
    press(player, "escape")
    assert not player.taken


def test_focus_lost_lets_all_keys_go():
    player = make()
    press(player, "up")
    player.handle(pygame_ce().event.Event(pygame_ce().WINDOWFOCUSLOST))
    np.testing.assert_allclose(walk(player), 0, atol=0.01)


def test_pause_step_and_speed():
    player = make()
    walk(player)
    press(player, "space")
    state, picture = player.views[0].now.state, player.canvas().picture()
    player.tick(5.0)
    assert player.views[0].now.state is state
    press(player, ".", ".")
    assert player.views[0].now.state.step == state.step + 2 and player.paused
    assert (player.canvas().picture() != picture).any()
    press(player, "space", "+", "+")
    assert player.speed == 4.0
    player.tick(SMALL.control_dt)
    assert player.views[0].now.state.step == state.step + 6
    press(player, *"-" * 20)
    assert player.speed == 0.25


def test_restart_and_next():
    player = make()
    begun = player.views[0].now.state
    walk(player)
    press(player, "up", "r")
    assert player.views[0].now.state.step == 0 and not player.taken
    np.testing.assert_array_equal(player.views[0].now.state.sheep_pos, begun.sheep_pos)
    press(player, "n")
    fresh = ShepherdingEnv(SMALL)
    fresh.reset(seed=trial_seed(5, 1))
    np.testing.assert_array_equal(player.views[0].now.state.sheep_pos, fresh.state.sheep_pos)
    assert player.views[0].source.label == "trial 1 of seed 5"


@pytest.mark.parametrize("name", ["b", "i", "l", "h", "tab"])
def test_toggles_change_the_picture(name):
    player = make()
    player.influence = name != "b"
    walk(player, steps=20)
    player.paused = True  # or the frame between two steps gives way to the step
    before = player.canvas().picture()
    press(player, name)
    assert (player.canvas().picture() != before).any()


def test_beams_of_the_chosen_one():
    player = make()
    walk(player, steps=20)
    press(player, "2", "b", "b")
    assert player.beams == "chosen"
    frame = player.views[0].now
    scan, earning = player._beams(frame, 1)
    np.testing.assert_array_equal(scan.ranges[:, 1], frame.scan.ranges[:, 1])
    assert not np.isfinite(scan.ranges[:, 0]).any() and not np.isfinite(earning[0]).any()
    press(player, "b")
    assert player.beams == "none"


def test_cameras():
    player = make()
    press(player, "tab", "c")
    assert player.camera == "follow"
    player.tick(30.0)
    np.testing.assert_allclose(player._cameras()[0].center, player._states()[0].shepherd_pos[0], atol=0.3)
    press(player, "c")
    fixed = [player._aim(0, player._states()[0]) for _ in range(2) if walk(player) is not None]
    assert fixed[0] == fixed[1]
    width = fixed[0].width
    player.handle(pygame_ce().event.Event(pygame_ce().MOUSEWHEEL, y=1))
    assert player._aim(0, player._states()[0]).width == pytest.approx(0.9 * width)


def test_the_end_is_the_end():
    player = Player([Live(Point("idle", "small", SMALL.but(n_steps=3)), 5)], SIZE)
    player.tick(60.0)
    assert player.over and player.views[0].now.state.step == 3
    press(player, ".")
    assert player.views[0].now.state.step == 3
    press(player, "n")
    assert not player.over


def test_side_by_side():
    player = make("strombom", "idle")
    assert player.canvas().picture().shape == (SIZE[1], 2 * SIZE[0], 3)
    left, right = (view.now.state for view in player.views)
    np.testing.assert_array_equal(left.sheep_pos, right.sheep_pos)
    mouse(player, "MOUSEBUTTONDOWN", (2 * SIZE[0] - 1, 1))
    assert player.chosen[0] == 1
    walk(player)
    assert (player.views[1].now.state.shepherd_path > 0).sum() == 1


def test_between():
    env = ShepherdingEnv(SMALL)
    env.reset(seed=0)
    before = env.state.but(shepherd_angle=[3.0, 0.0])
    after = before.but(shepherd_angle=[-3.0, 1.0], shepherd_pos=before.shepherd_pos + 2, time=before.time + 0.2)
    half = between(before, after, 0.5)
    np.testing.assert_allclose(half.shepherd_pos, before.shepherd_pos + 1)
    np.testing.assert_allclose(np.cos(half.shepherd_angle), [-1.0, np.cos(0.5)])  # the short way round
    assert half.time == pytest.approx(before.time + 0.1)


class Hands:
    """A user: a list of events for each picture that is shown, and then the window's cross."""

    def __init__(self, window, *todo):
        self.window, self.todo, self.shown, self.frames = window, [*todo], [], 0

    size = property(lambda self: self.window.size)

    def wait(self, fps):
        return 0.2

    def events(self):
        pygame = pygame_ce()
        for event in self.todo.pop(0) if self.todo else [pygame.event.Event(pygame.QUIT)]:
            pygame.event.post(event)
        return self.window.events()

    def show(self, canvas):
        self.window.show(canvas)
        screen = pygame_ce().display.get_surface()
        self.shown.append(pygame_ce().surfarray.array3d(screen))

    def close(self):
        self.window.close()


def showing():
    """Lead a shepherd up through a real window, give it back; what was shown and how far it went."""
    player = make()
    window = Window(player.size, "test")
    hands = Hands(window, [key("up")], *[[]] * 5, [key("up", "KEYUP"), key("g"), key("b")], [], [])
    begun = player.views[0].now.state.shepherd_pos[0]
    run(player, hands)
    return player, hands.shown, player.views[0].trails[6][0] - begun


def test_a_window_from_its_opening_to_its_closing():
    player, shown, way = showing()
    assert not player.running and not pygame_ce().display.get_init()
    assert len(shown) == 10 and all(picture.std() > 5 for picture in shown)
    assert (shown[0] != shown[5]).any()
    np.testing.assert_allclose(way, (0, 1.8), atol=0.2)  # 6 steps up
    assert not player.taken and player.beams == "all"


@pytest.mark.skipif(shutil.which("Xvfb") is None, reason="NO X SERVER TO TEST A REAL WINDOW ON: install Xvfb")
def test_a_window_on_a_real_display(monkeypatch):
    read, write = os.pipe()
    command = ["Xvfb", "-displayfd", str(write), "-screen", "0", "800x600x24", "-nolisten", "tcp"]
    with subprocess.Popen(command, pass_fds=[write], stderr=subprocess.DEVNULL) as server:
        try:
            os.close(write)
            with os.fdopen(read) as told:
                monkeypatch.setenv("DISPLAY", f":{told.readline().strip()}")
            monkeypatch.delenv("SDL_VIDEODRIVER")
            monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
            pygame_ce().display.quit()
            driver = []
            show = Window.show
            monkeypatch.setattr(
                Window, "show", lambda self, c: (driver.append(pygame_ce().display.get_driver()), show(self, c))
            )
            _, shown, way = showing()
            assert set(driver) == {"x11"}
            assert all(picture.std() > 5 for picture in shown)
            np.testing.assert_allclose(way, (0, 1.8), atol=0.2)
        finally:
            pygame_ce().display.quit()
            server.terminate()


def test_no_display(monkeypatch):
    for name in ("SDL_VIDEODRIVER", "SDL_VIDEO_DRIVER", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    pygame_ce().display.quit()
    with pytest.raises(DisplayError, match=r"no display for a window \(neither DISPLAY.*--out FILE.mp4"):
        Window(SIZE, "test")
    monkeypatch.setenv("SDL_VIDEODRIVER", "nonesuch")
    with pytest.raises(DisplayError, match="no display for a window"):
        Window(SIZE, "test")
    assert not pygame_ce().display.get_init()
