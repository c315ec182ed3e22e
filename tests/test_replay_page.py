"""The page of a replay: self-contained, of a bounded size, and played in a real browser."""

import json
import re
import shutil
import time
from html.parser import HTMLParser

import numpy as np
import pymunk
import pytest

from shepherd_phys.controllers import Idle
from shepherd_phys.controllers.recording import recorded
from shepherd_phys.envs import ShepherdingEnv
from shepherd_phys.flock import Strombom
from shepherd_phys.obstacles import Box, Fence, Pillar, outlines
from shepherd_phys.outlines import edge
from shepherd_phys.replay import ReplayError
from shepherd_phys.scenario import SCENARIOS, Scenario
from shepherd_phys.scripts.replay_page import LEVELS, page, write_page
from shepherd_phys.state import unit

pytest.importorskip("bokeh", reason="NO PAGE WAS MADE: bokeh is missing")

HOSTILE = "</script><script>window.injected = 1</script><img src=x onerror='window.injected = 2'>{{ bokeh }}"
SOLID = (Pillar(center=(6.0, -7.0)), Box(center=(-5.0, 14.0), size=(2.0, 1.0), angle=0.4))
SPACE = pymunk.Space()
SOLID += (Fence(start=(20.0, -5.0), end=(20.0, 5.0), gap=2.0),)


class Pacing:
    lidar = None

    def reset(self, rng):
        self.rng = rng

    def act(self, observation, state):
        return (state.sheep_pos.mean(axis=0) - state.shepherd_pos) / 20.0


@pytest.fixture(scope="module")
def replay():
    scenario = Scenario(
        n_sheep=12, n_flocks=2, shepherds=2, n_steps=60, flock=Strombom(n_neighbours=4), obstacles=SOLID
    )
    return recorded(Pacing(), ShepherdingEnv(scenario), 4, name=HOSTILE, scenario_name="a & b <i>")[1]


class Tags(HTMLParser):
    """What a page would load, and its scripts."""

    def __init__(self):
        super().__init__()
        self.loads, self.scripts, self.images = [], 0, 0

    def handle_starttag(self, tag, attrs):
        self.scripts += tag == "script"
        self.images += tag == "img"
        self.loads += [value for name, value in attrs if name in ("src", "href", "srcset", "data") and value]


def test_a_page_loads_nothing_and_runs_no_name(replay):
    tags = Tags()
    text = page(replay)
    tags.feed(text)
    assert tags.loads == ["data:,"]
    assert tags.images == 0
    harmless = Tags()
    values = {name: getattr(replay, name) for name in type(replay).__dataclass_fields__}
    harmless.feed(page(type(replay)(**{**values, "controller": "me", "scenario_name": ""})))
    assert tags.scripts == harmless.scripts
    style = re.search(r"<style>(.*?)</style>", text, re.DOTALL)[1]
    assert "url(" not in style and "@import" not in style


def test_a_replay_has_one_page_however_many_were_made_before(replay):
    assert page(replay) == page(replay)


def test_a_page_of_the_papers_episode_has_a_bounded_size(tmp_path):
    env = ShepherdingEnv("paper", rewards={"zero": (1.0, lambda *_: 0.125)}, lidar=None)
    _, replay = recorded(Idle(), env, 1)
    assert (replay.n_steps, replay.n_sheep) == (1000, 100)
    write_page(replay, tmp_path / "page.html")
    assert (tmp_path / "page.html").stat().st_size <= 5_000_000


def test_a_page_is_written_whole_or_not_at_all(replay, tmp_path):
    with pytest.raises(ReplayError, match="cannot be written"):
        write_page(replay, tmp_path / "no" / "page.html")


@pytest.mark.parametrize("thing", SOLID, ids=lambda thing: type(thing).__name__)
def test_obstacles_are_drawn_as_they_are(thing):
    for outline, shape in zip(outlines(thing, 0), thing.shapes(SPACE.static_body), strict=True):
        corners = edge(outline)
        shape.cache_bb()  # or it does not know yet where it is
        for x, y in corners.tolist():
            assert shape.point_query((x, y)).distance == pytest.approx(0.0, abs=1e-6)
        area = shape.area if hasattr(shape, "area") else None
        x, y = corners.T
        assert abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))) / 2 == pytest.approx(area, rel=0.02)


# --- in Chromium ---


@pytest.fixture(scope="module")
def browser():
    program = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    driver = shutil.which("chromedriver")
    if program is None or driver is None:
        pytest.skip("NO PAGE WAS OPENED: chromium and chromedriver are not installed (.ci/run tries to)")
    webdriver = pytest.importorskip("selenium.webdriver", reason="NO PAGE WAS OPENED: selenium is missing")
    options = webdriver.ChromeOptions()
    options.binary_location = program
    for flag in ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--window-size=1280,1040"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    opened = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
    opened.set_network_conditions(offline=True, latency=0, throughput=0)
    yield opened
    opened.quit()


def until(browser, condition, seconds=120):
    """Wait until a condition in the page holds."""
    end = time.monotonic() + seconds
    while not browser.execute_script(f"return {condition}"):
        assert time.monotonic() < end, f"never: {condition}"
        time.sleep(0.05)


def opened(browser, path):
    browser.get(path.as_uri())
    until(browser, "window.replay !== undefined")
    return browser


@pytest.fixture(scope="module")
def shown(browser, replay, tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "page.html"
    write_page(replay, path)
    return opened(browser, path)


def numbers(browser, kind):
    """Positions (K, 2) that the page shows now."""
    got = browser.execute_script(f"const d = replay.sources.{kind}.data; return [[...d.x], [...d.y], [...d.number]]")
    assert got[2] == list(range(1, len(got[0]) + 1))  # as in watch and on figures
    return np.array(got[:2], dtype=float).T


def test_it_draws_without_errors_and_runs_no_name(shown):
    assert [entry for entry in shown.get_log("browser") if entry["level"] == "SEVERE"] == []
    assert shown.execute_script("return window.injected") is None
    assert shown.find_element("tag name", "h1").text == HOSTILE
    # the canvases hold a picture, not one colour
    colors = shown.execute_script("""
        const seen = new Set();
        const canvases = (root) => [...root.querySelectorAll('*')].flatMap((e) =>
          [...(e.tagName === 'CANVAS' ? [e] : []), ...(e.shadowRoot ? canvases(e.shadowRoot) : [])]);
        for (const canvas of canvases(document.querySelector('#world'))) {
          const context = canvas.getContext('2d');
          if (!context || !canvas.width) continue;
          const data = context.getImageData(0, 0, canvas.width, canvas.height).data;
          for (let i = 0; i < data.length; i += 4) seen.add(data[i] << 16 | data[i + 1] << 8 | data[i + 2]);
        }
        return seen.size""")
    assert colors > 20


def test_a_metre_is_as_long_across_as_it_is_up(shown):
    for size in ((1280, 1040), (500, 900)):
        shown.set_window_size(*size)
        until(
            shown,
            """(() => { const v = replay.views.world, b = v.frame.bbox, m = v.model;
            const across = (m.x_range.end - m.x_range.start) / b.width;
            const up = (m.y_range.end - m.y_range.start) / b.height;
            return b.width > 100 && Math.abs(across / up - 1) < 0.01; })()""",
        )
        assert shown.execute_script("return document.documentElement.scrollWidth <= window.innerWidth")
    shown.set_window_size(1280, 1040)


@pytest.mark.parametrize("step", [0, 1, 33, 60])
def test_the_slider_scrubs_to_a_step(shown, replay, step):
    shown.execute_script(
        "const s = document.querySelector('#scrub'); s.value = arguments[0]; s.dispatchEvent(new Event('input'))", step
    )
    state = replay[step]
    error = shown.execute_script("return JSON.parse(document.querySelector('#episode_data').textContent).step")
    assert error * LEVELS < 200  # a field of less than 200 m in so many levels
    for kind, places in (("sheep", state.sheep_pos), ("shepherds", state.shepherd_pos)):
        assert np.abs(numbers(shown, kind) - places).max() <= error * 0.501
    for kind, ways in (("sheep", state.sheep_heading), ("shepherds", unit(state.shepherd_vel))):
        at = shown.execute_script(f"const d = replay.sources.{kind}_faces.data; return [[...d.x], [...d.y]]")
        looking = np.hypot(*ways.T) > 0
        ahead = np.reshape(at, (2, -1)).T - numbers(shown, kind)[looking]
        assert ((unit(ahead) * ways[looking]).sum(axis=1) > 0.999).all()  # the dot is in front
    data = shown.execute_script("const d = replay.sources.sheep.data; return [[...d.away], [...d.speed], d.state]")
    assert np.allclose(data[0], state.sheep_goal_distance, rtol=0, atol=2 * error)
    assert np.allclose(data[1], np.hypot(*state.sheep_vel.T), rtol=0, atol=1e-3)
    for i, text in enumerate(data[2]):
        assert text.startswith("arrived" if state.sheep_arrived[i] else "wild")
        assert ("threatened" in text) == bool(replay.threatened(step)[i])
        assert text.endswith("in the goal") == bool(state.sheep_in_goal[i])
    for name in ("rewards", "in_goal"):
        where = f"replay.views.{name}.model.document.get_model_by_name('{name}_cursor').location"
        assert shown.execute_script(f"return {where}") == pytest.approx(state.time)
    assert shown.find_element("id", "time").text == f"{state.time:.1f}"


def test_it_plays_pauses_and_goes_faster(shown):
    shown.execute_script("replay.seek(0); const s = document.querySelector('#speed'); s.value = '0.5'; "
                         "s.dispatchEvent(new Event('change'))")  # fmt: skip
    assert shown.execute_script("return replay.speed") == 0.5
    shown.find_element("id", "play").click()
    until(shown, "replay.at > 0.5")
    assert shown.find_element("id", "play").text == "Pause"
    shown.find_element("id", "play").click()
    stopped = shown.execute_script("return [replay.playing, replay.at]")
    assert stopped[0] is False and stopped[1] == int(stopped[1])
    shown.execute_async_script("const done = arguments[0]; setTimeout(done, 300)")
    assert shown.execute_script("return replay.at") == stopped[1]
    # time goes as fast as it is asked to: 60 steps of 0.2 s are 12 s
    rates = shown.execute_async_script("""
        const done = arguments[0], rates = [];
        (async () => {
          for (const speed of [1, 4]) {
            replay.speed = speed; replay.seek(0); replay.play();
            const frame = () => new Promise(requestAnimationFrame);
            await frame(); await frame(); await frame();
            const [from, at] = [await frame(), replay.at];
            let now = from;
            while (now - from < 1000) now = await frame();
            rates.push((replay.at - at) / ((now - from) / 1000) / speed);
            replay.pause();
          }
          done(rates);
        })()""")
    assert rates == pytest.approx([5.0, 5.0], rel=0.2)
    shown.execute_script("replay.speed = 1000; replay.seek(0); replay.play()")
    until(shown, "!replay.playing && replay.at === replay.n_steps")


def test_keys_and_clicks_move_it(shown):
    from selenium.webdriver import ActionChains, Keys

    shown.execute_script("replay.seek(10); document.activeElement.blur()")
    press = ActionChains(shown)
    for keys, step in (([Keys.ARROW_RIGHT], 11), ([Keys.ARROW_LEFT], 10), ([Keys.END], 60), ([Keys.HOME], 0)):
        press.send_keys(*keys).perform()
        assert shown.execute_script("return replay.at") == step
    shown.execute_script("replay.speed = 0.5")
    press.send_keys(" ").perform()
    assert shown.execute_script("return replay.playing")
    press.send_keys(" ").perform()
    assert not shown.execute_script("return replay.playing")
    plot = shown.find_element("id", "rewards")
    press.move_to_element_with_offset(plot, plot.size["width"] // 4, 0).click().perform()
    assert 35 < shown.execute_script("return replay.at") < 60


def test_hovering_tells_an_agents_numbers(shown, replay):
    from selenium.webdriver import ActionChains

    shown.execute_script("replay.seek(20)")
    x, y = numbers(shown, "shepherds")[1]
    at = shown.execute_script("""
        const v = replay.views.world, m = v.model, b = v.frame.bbox, r = v.el.getBoundingClientRect();
        return [r.left + b.left + (arguments[0] - m.x_range.start) / (m.x_range.end - m.x_range.start) * b.width,
                r.top + b.top + (m.y_range.end - arguments[1]) / (m.y_range.end - m.y_range.start) * b.height]
    """, x, y)  # fmt: skip
    action = ActionChains(shown)
    action.w3c_actions.pointer_action.move_to_location(round(at[0]) - 2, round(at[1]))
    action.w3c_actions.pointer_action.move_to_location(round(at[0]), round(at[1]))
    action.perform()
    deep = """(() => { const all = (root) => [...root.querySelectorAll('*')].map((e) =>
        (e.shadowRoot ? all(e.shadowRoot) : '') + (e.matches('.bk-tooltip-row-value, span') ? e.textContent : ''))
        .join(' '); return all(document.body); })()"""
    until(shown, f"{deep}.includes('m/s')")
    text = shown.execute_script(f"return {deep}")
    assert f"{x:.2f}" in text and f"{y:.2f}" in text


def first_picture(browser, path):
    """Milliseconds from asking for a page to its first picture of the world."""
    return float(opened(browser, path).execute_script("return replay.first_picture"))


@pytest.mark.slow
def test_the_first_picture_of_the_papers_episode(browser, tmp_path, capsys):
    """Tell how long it takes; how fast a machine is, is no property of the page."""
    _, replay = recorded(Idle(), ShepherdingEnv(SCENARIOS["paper"], lidar=None), 1)
    write_page(replay, tmp_path / "page.html")
    taken = [first_picture(browser, tmp_path / "page.html") for _ in range(3)]
    with capsys.disabled():
        print(f"\nfirst picture after {', '.join(f'{ms:.0f}' for ms in taken)} ms")
    assert json.loads(browser.execute_script("return JSON.stringify(replay.n_steps)")) == 1000
