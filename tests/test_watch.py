"""``shepherd-phys watch`` as a command, its films, and the env's own window and Gymnasium's films."""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import gymnasium as gym
import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image, ImageSequence

from shepherd_phys.canvas import pygame_ce
from shepherd_phys.controllers import StrombomTeam
from shepherd_phys.controllers.recording import record
from shepherd_phys.envs import ShepherdingEnv
from shepherd_phys.film import write_film
from shepherd_phys.layouts import Scattered
from shepherd_phys.replay_file import load_replay, save_replay
from shepherd_phys.scenario import load_scenario
from shepherd_phys.scripts import watch
from shepherd_phys.scripts.main import main
from shepherd_phys.scripts.player import Player
from shepherd_phys.scripts.replay_page import page
from shepherd_phys.scripts.sources import Recorded, shown_name
from shepherd_phys.settings import SettingsError

PROGRAM = str(Path(sys.executable).parent / "shepherd-phys")
HEADLESS = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER")}


def command(tmp_path, *words):
    return subprocess.run(
        [PROGRAM, "watch", *words],
        cwd=tmp_path,
        env=HEADLESS,
        capture_output=True,
        text=True,
        timeout=280,
        check=False,
    )


def frames_of(path):
    """The pictures of a film, uint8 (K, h, w, 3), and how many of them a second."""
    if path.suffix.lower() == ".gif":
        with Image.open(path) as film:
            pictures = np.stack([np.array(frame.convert("RGB")) for frame in ImageSequence.Iterator(film)])
            return pictures, 1000 / film.info["duration"]
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", str(path), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    done = subprocess.run(command, capture_output=True, check=True)
    w, h, fps = re.search(r"yuv420p.* (\d+)x(\d+)\W.* ([\d.]+) fps", done.stderr.decode()).groups()
    return np.frombuffer(done.stdout, np.uint8).reshape(-1, int(h), int(w), 3), float(fps)


@pytest.mark.parametrize(
    ("name", "words", "shape"),
    [
        ("film.mp4", ["--controllers", "strombom"], (120, 160)),
        ("film.GIF", ["--controllers", "strombom", "idle", "--dark", "--beams", "--camera", "follow"], (120, 320)),
    ],
)
def test_films(tmp_path, name, words, shape):
    small = ["--scenario", "small", "--size", "160", "120", "--steps", "8", "--speed", "2", "--fps", "10"]
    done = command(tmp_path, *words, *small, "--out", name)
    assert done.returncode == 0, done.stderr
    assert done.stdout == f"{name}  (9 pictures)\n"  # 8 steps of 0.2 s at twice the speed and 10 fps, and the start
    assert os.listdir(tmp_path) == [name]
    frames, fps = frames_of(tmp_path / name)
    assert frames.shape[1:3] == shape and len(frames) >= 5  # a GIF leaves out pictures that repeat the last one
    assert all(frame.std() > 3 for frame in frames)
    assert (frames[0] != frames[-1]).any()
    assert fps == pytest.approx(10)


@pytest.mark.parametrize("fps", [3, 10, 24, 30, 40, 50])
def test_a_gif_lasts_as_long_as_it_should(tmp_path, fps):
    write_film([np.full((20, 20, 3), 2 * k, np.uint8) for k in range(2 * fps)], tmp_path / "a.gif", fps)
    with Image.open(tmp_path / "a.gif") as film:
        lengths = [frame.info["duration"] for frame in ImageSequence.Iterator(film)]
    assert len(lengths) == 2 * fps and sum(lengths) == 2000
    assert max(lengths) - min(lengths) <= 10


@pytest.mark.skipif(os.name == "nt", reason="Windows ends a process without asking")
def test_a_film_that_is_told_to_end_leaves_nothing(tmp_path):
    small = ["--controllers", "idle", "--scenario", "small", "--size", "160", "120", "--speed", "0.25"]
    running = subprocess.Popen(
        [PROGRAM, "watch", *small, "--out", "a.mp4"], cwd=tmp_path, env=HEADLESS, stderr=subprocess.PIPE, text=True
    )
    end = time.monotonic() + 120
    while not (tmp_path / "a.mp4.part").exists():
        assert running.poll() is None and time.monotonic() < end
        time.sleep(0.02)
    running.terminate()
    assert running.communicate(timeout=60)[1] == ""
    assert running.returncode == 128 + signal.SIGTERM
    assert os.listdir(tmp_path) == []


def test_the_last_picture_of_a_film(tmp_path):
    words = ["--controllers", "idle", "--scenario", "small", "--size", "90", "80", "--steps", "3"]
    done = command(tmp_path, *words, "--out", "end.png")
    assert (done.returncode, done.stdout) == (0, "end.png  (1 picture)\n"), done.stderr
    with Image.open(tmp_path / "end.png") as picture:
        assert picture.size == (90, 80) and np.array(picture).std() > 3


def test_odd_sizes_make_films_that_play(tmp_path):
    pictures = [np.full((41, 63, 3), 20 * k, np.uint8) for k in range(5)]
    assert write_film(pictures, tmp_path / "a.mp4", 10) == 5
    frames, _ = frames_of(tmp_path / "a.mp4")
    assert frames.shape == (5, 40, 62, 3)
    np.testing.assert_allclose(frames.mean(axis=(1, 2, 3)), [0, 20, 40, 60, 80], atol=3)
    assert write_film(pictures, tmp_path / "a.gif", 10) == 5
    np.testing.assert_allclose(frames_of(tmp_path / "a.gif")[0].mean(axis=(1, 2, 3)), [0, 20, 40, 60, 80], atol=3)


@pytest.mark.parametrize("name", ["a.mp4", "a.gif"])
def test_a_film_is_whole_or_not_there(tmp_path, name):
    def broken():
        yield np.zeros((40, 40, 3), np.uint8)
        raise RuntimeError("no more")

    path = tmp_path / name
    path.write_bytes(b"old")
    with pytest.raises(RuntimeError, match="no more"):
        write_film(broken(), path, 10)
    assert path.read_bytes() == b"old" and os.listdir(tmp_path) == [name]
    with pytest.raises(ValueError, match="at least one picture"):
        write_film([], path, 10)


def test_without_moviepy(monkeypatch, capsys, tmp_path):
    monkeypatch.setitem(sys.modules, "moviepy.video.io", None)
    assert main(["watch", "--out", str(tmp_path / "a.mp4")]) == 2
    assert capsys.readouterr().err == 'shepherd-phys watch: films need moviepy: pip install "shepherd-phys[film]"\n'


def test_without_pygame(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "pygame", None)
    pygame_ce.cache_clear()
    assert main(["watch"]) == 2
    assert 'pip install "shepherd-phys[render]"' in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--out", "film.avi"], "film.avi: a film ends in .mp4 or .gif (given: '.avi')"),
        (["--out", "film"], "(given: 'no ending')"),
        (["--out", "nowhere/film.mp4"], "film cannot be written: no such folder: 'nowhere'"),
        (["--out", "nowhere/end.png"], "picture cannot be written: no such folder: 'nowhere'"),
        (["--replay", "a.npz", "--out", "nowhere/a.html"], "page cannot be written: no such folder: 'nowhere'"),
        (["--out", "film.gif", "--fps", "200"], "fps: must be from 1 to 50"),
        (["--controllers", "wolf"], "controllers: 'wolf' is unknown"),
        (["--controllers", "a", "b", "c"], "controllers: one or two side by side (given: 3)"),
        (["--controllers", "none.json"], "none.json"),
        (["--scenario", "moon"], "scenario: 'moon'"),
        (["--rewards", "wool"], "rewards: 'wool' is not one of"),
        (["--speed", "0"], "speed: 0.0 is impossible"),
        (["--size", "3", "3"], "size: must be"),
        (["--size", "8000", "99", "--controllers", "idle", "idle"], "size: two pictures"),
        (["--flocks", "0"], "flocks: 0 is impossible"),
        (["--steps", "5"], "--steps: is of a film"),
        (["--replay", "none.npz"], "none.npz"),
        (["--replay", "a.npz", "--seed", "5"], "--seed: does not go with --replay"),
        (["--replay", "a.npz", "b.npz", "c.npz"], "--replay: one or two side by side (given: 3)"),
        (["--out", "a.html"], "--out: a page is made of a replay: evaluate --save-replay DIR leaves one"),
        (["--replay", "a.npz", "--out", "a.html", "--dark"], "--dark: does not go with --out a.html"),
        (["--camera", "near"], "--camera"),
        ([], "no display for a window (neither DISPLAY nor WAYLAND_DISPLAY is set)"),
    ],
)
def test_bad_input_is_one_line(words, message, monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    for name in ("SDL_VIDEODRIVER", "SDL_VIDEO_DRIVER", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    assert main(["watch", *words]) == 2
    said = capsys.readouterr()
    assert said.out == "" and said.err.count("\n") == 1
    assert said.err.startswith("shepherd-phys watch: ") and message in said.err
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("name", ["folder.png", "folder.mp4"])
def test_a_folder_in_the_way_is_told_before_anything_is_run(name, monkeypatch, capsys, tmp_path):
    (tmp_path / name).mkdir()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(watch, "make_player", None)
    assert main(["watch", "--out", name]) == 2
    assert f"cannot be written: a folder is in its place: '{name}'\n" in capsys.readouterr().err


def test_a_controller_that_fails_leaves_no_film(tmp_path):
    (tmp_path / "mine.py").write_text(
        "import numpy as np\nclass Bad:\n    lidar = None\n    def reset(self, rng): ...\n"
        "    def act(self, observation, state): return np.full((3, 2), np.nan)\n"
    )
    done = command(tmp_path, "--controllers", "mine:Bad", "--out", "film.mp4")
    assert done.returncode == 1
    assert "NaN" in done.stderr and done.stderr.count("\n") == 1
    assert not list(tmp_path.glob("film*"))


@pytest.mark.parametrize(
    ("words", "status", "message"),
    [
        (["--controllers", "mine:Bad"], 1, "KeyError: 'lost' (mine.py:5)"),
        (["--controllers", "idle", "--body", "mine:Bomb"], 2, "OSError: no parts (mine.py:7)"),
    ],
)
def test_what_a_users_class_raises_is_one_line(words, status, message, tmp_path, monkeypatch, capsys):
    (tmp_path / "mine.py").write_text(
        "from shepherd_phys.bodies import Disc\nclass Bad:\n    lidar = None\n    def reset(self, rng): ...\n"
        "    def act(self, observation, state): raise KeyError('lost')\nclass Bomb(Disc):\n"
        "    def build(self): raise OSError('no parts')\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "mine", raising=False)
    assert watch.main([*words, "--scenario", "small", "--out", "film.gif"]) == status
    (line,) = capsys.readouterr().err.splitlines()
    assert line == f"shepherd-phys watch: {message}"
    assert not list(tmp_path.glob("film*"))


def test_options_reach_the_player():
    words = ["--controllers", "idle", "--scenario", "small", "--flocks", "1", "--shepherds", "3", "--body", "Flyer"]
    options = watch.read_options([*words, "--sheep", "9", "--dark", "--beams", "--speed", "4", "--trial", "2"])
    player = watch.make_player(watch.live(options), options)
    scenario = player.views[0].source.scenario
    assert (scenario.n_flocks, scenario.n_shepherds, scenario.n_sheep) == (1, 3, 9)
    assert type(scenario.shepherds[0]).__name__ == "Flyer"
    assert (player.theme, player.beams, player.speed) == ("dark", "all", 4.0)
    assert player.views[0].source.label == "trial 2 of seed 20000"


def test_the_window_of_the_env(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    env = gym.make("shepherd_phys.envs:Shepherding-v0", scenario="small", render_mode="human", render_size=(120, 90))
    world = env.unwrapped
    world.metadata = {**world.metadata, "render_fps": 1000}
    pygame = pygame_ce()
    env.reset(seed=0)
    first = pygame.surfarray.array3d(pygame.display.get_surface())
    assert first.shape == (120, 90, 3) and first.std() > 3
    for _ in range(5):
        env.step(np.ones((2, 2), np.float32))
        assert env.render() is None
    assert (pygame.surfarray.array3d(pygame.display.get_surface()) != first).any()
    pygame.event.post(pygame.event.Event(pygame.QUIT))
    env.step(np.ones((2, 2), np.float32))
    assert not pygame.display.get_init()
    env.step(np.ones((2, 2), np.float32))  # the episode goes on
    assert not pygame.display.get_init()
    env.close()


def test_films_of_gymnasium(tmp_path):
    env = gym.make("shepherd_phys.envs:Shepherding-v0", scenario="small", render_mode="rgb_array", render_size=(96, 64))
    film = gym.wrappers.RecordVideo(env, str(tmp_path / "films"), episode_trigger=lambda _: True, disable_logger=True)
    film.reset(seed=0)
    for _ in range(6):
        film.step(np.ones((2, 2), np.float32))
    film.close()
    (path,) = (tmp_path / "films").glob("*.mp4")
    frames, fps = frames_of(path)
    assert frames.shape[1:] == (64, 96, 3) and len(frames) >= 6 and all(frame.std() > 3 for frame in frames)
    assert fps == 5  # as fast as the world


def test_looks_of_the_env():
    def picture(**options):
        env = ShepherdingEnv("small", render_mode="rgb_array", render_size=(200, 160), **options)
        env.reset(seed=0)
        return env.render()

    light = picture()
    assert picture(render_theme="dark").mean() < 80 < light.mean()
    assert (picture(render_beams=True) != light).any()
    with pytest.raises(SettingsError, match="render_theme: 'pink' is not one of light, dark"):
        picture(render_theme="pink")


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    """A short episode in a file."""
    path = tmp_path_factory.mktemp("replay") / "episode.npz"
    scenario = load_scenario("small").but(n_steps=6, layout=Scattered(count=2))
    save_replay(record(StrombomTeam(), ShepherdingEnv(scenario, rewards="wild"), seed=7), path)
    return path


def test_a_replay_is_a_source_of_the_states_that_were(kept):
    replay = load_replay(kept)
    source = Recorded(replay)
    frame, told = source.restart(), []
    while not frame.over:
        told.append(frame)
        frame = source.advance({0: np.array([1.0, 0.0])})  # nobody heeds that
    assert [one.state.step for one in [*told, frame]] == list(range(7))
    np.testing.assert_array_equal(frame.state.sheep_pos, replay[-1].sheep_pos)
    assert set(told[0].rewards.values()) == {0.0}
    assert frame.rewards == {name: pytest.approx(values.sum()) for name, values in replay.rewards.items()}
    assert source.restart(onward=True).state.step == 0
    player = Player([Recorded(replay), Recorded(replay)], (320, 160))
    first = player.canvas().picture()
    player.tick(1.0)
    assert (player.canvas().picture() != first).any()


@pytest.mark.parametrize(
    ("controller", "name"),
    [
        ("collie", "collie"),
        ("my.file:Own", "my.file:Own"),
        ("best.json", "best"),
        ("runs/obst/best.json", "obst/best"),
        ("/best.json", "best"),
    ],
)
def test_policies_of_different_runs_have_different_titles(controller, name):
    assert shown_name(controller) == name


def test_films_and_pages_of_a_replay(kept, tmp_path):
    done = command(
        tmp_path, "--replay", str(kept), str(kept), "--out", "two.gif", "--size", "120", "90", "--speed", "2"
    )
    assert done.returncode == 0 and done.stdout.startswith("two.gif  ("), done.stderr
    assert frames_of(tmp_path / "two.gif")[0].shape[1:] == (90, 240, 3)
    done = command(tmp_path, "--replay", str(kept), "--out", "page.html")
    assert (done.returncode, done.stdout) == (0, "page.html\n"), done.stderr
    assert (tmp_path / "page.html").read_text("utf-8") == page(load_replay(kept))
    (tmp_path / "broken.npz").write_bytes(kept.read_bytes()[:500])
    done = command(tmp_path, "--replay", "broken.npz", "--out", "other.html")
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and "broken.npz" in done.stderr
    assert not (tmp_path / "other.html").exists()
