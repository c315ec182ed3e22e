"""`write_page`: a replay as one HTML file that plays in any browser, with no network. Needs bokeh.

Everything is inside the file: bokeh's own script, the page's, and the episode. Places are whole numbers of 16 bits
across the field, about a millimetre each; the browser turns them back. The page is ``replay_page.html``.
"""

from __future__ import annotations

import base64
import html
import importlib.util
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from shepherd_phys.files import whole_file
from shepherd_phys.obstacles import outlines
from shepherd_phys.outlines import edge
from shepherd_phys.render import THEMES
from shepherd_phys.replay import Replay, ReplayError, detection_radius
from shepherd_phys.state import Floats, unit

TEMPLATE = Path(__file__).with_name("replay_page.html")
THEME = THEMES["light"]
TERMS = ("#2B7A3D", "#B4501E", "#2663BF", "#9900FF", "#7A6A00", "#993D74", "#1F6F78", "#4C0F00")
"""Colours of reward terms, from the first again after the last."""
STATES = ("wild, grazing", "wild, threatened", "arrived, grazing", "arrived, threatened")
"""What the two bits of a sheep's state mean; the second group of four: in the goal now."""
LEVELS = 65_535
"""Whole numbers across the field."""
TURNS = 255
"""Directions in a full turn, for the dots in front of agents."""


def write_page(replay: Replay, path: str | Path) -> None:
    """Write a replay's page to a file, which appears whole or not at all.

    Raises:
        ReplayError: bokeh is missing, or the file cannot be written; the message says which.
    """
    path = Path(path)
    text = page(replay)
    try:
        with whole_file(path) as part:
            part.write_text(text, encoding="utf-8")
    except OSError as error:
        raise ReplayError(f"{path}: cannot be written ({error.strerror})") from None


def page(replay: Replay) -> str:
    """A replay's page as HTML.

    Raises:
        ReplayError: bokeh is missing.
    """
    if importlib.util.find_spec("bokeh") is None:
        raise ReplayError("a page needs bokeh (pip install 'shepherd-phys[replay]')")
    from bokeh.embed import json_item
    from bokeh.resources import Resources

    field = _field(replay)
    plots = {"world": json_item(_world(replay, field)), "rewards": json_item(_rewards(replay))}
    plots["in_goal"] = json_item(_in_goal(replay))
    title = f"{replay.controller}, {replay.scenario_name or 'a scenario'}, seed {replay.seed}"
    parts = {
        "title": html.escape(title),
        "controller": html.escape(replay.controller or "a controller"),
        "facts": html.escape(_facts(replay)),
        "result": html.escape(_result(replay)),
        "result_class": "success" if replay.success else "short",
        "bokeh": Resources(mode="inline", components=["bokeh"], minified=True).render_js(),
        "plots": _script(_numbered(plots, {})),
        "episode": _script(_episode(replay, field)),
    }
    template = TEMPLATE.read_text(encoding="utf-8")
    # one pass: nothing that is put in is searched for further places
    return re.sub(r"\{\{ (\w+) \}\}", lambda place: parts[place[1]], template)


def _facts(replay: Replay) -> str:
    parts = [
        replay.scenario_name,
        f"{replay.n_sheep} sheep in {_counted(replay.scenario.n_flocks, 'flock')}",
        _counted(replay.n_shepherds, "shepherd"),
        f"seed {replay.seed}",
        f"version {replay.version}",
    ]
    return " · ".join(part for part in parts if part)


def _counted(n: int, what: str) -> str:
    return f"{n} {what}{'s' * (n != 1)}"


def _result(replay: Replay) -> str:
    there = replay.in_goal[-1]
    walked = replay.states["shepherd_path"][-1]
    path = f", {walked.mean():.0f} m walked by a shepherd" if len(walked) else ""
    seconds = replay.n_steps * replay.scenario.control_dt
    return f"{there} of {replay.n_sheep} sheep in the goal after {seconds:.0f} s{path}"


def _numbered(data: Any, numbers: dict[str, str]) -> Any:
    """The JSON of bokeh, its models numbered from 1: bokeh counts on through a process, and a replay has one page."""
    if isinstance(data, dict):
        return {
            key: numbers.setdefault(value, f"p{len(numbers) + 1}")
            if key in ("id", "root_id") and isinstance(value, str)
            else _numbered(value, numbers)
            for key, value in data.items()
        }
    return [_numbered(value, numbers) for value in data] if isinstance(data, list) else data


def _script(data: Any) -> str:
    """Data as JSON that cannot end the script element that it stands in."""
    text = json.dumps(data, allow_nan=False, ensure_ascii=True, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


# --- the episode, for the browser ---


def _field(replay: Replay) -> tuple[float, float, float]:
    """Centre and side of the square in which all of it happens [m]."""
    goal, radius = replay.constants["goal_pos"], replay.scenario.goal_radius
    points = [replay.states["sheep_pos"].reshape(-1, 2), replay.states["shepherd_pos"].reshape(-1, 2)]
    points += [goal[None] - radius, goal[None] + radius]
    everything = np.concatenate(points)
    low, high = everything.min(axis=0), everything.max(axis=0)
    x, y = ((low + high) / 2).tolist()
    return x, y, max(float((high - low).max()), 8.0) * 1.06


def _whole(values: ArrayLike, low: float, step: float) -> str:
    """Values as unsigned 16-bit numbers of steps above ``low``, base64."""
    levels = np.rint((np.asarray(values, dtype=float) - low) / step)
    return base64.b64encode(np.clip(levels, 0, LEVELS).astype("<u2").tobytes()).decode()


def _looks(replay: Replay) -> Floats:
    """Where the shepherds look (T, P, 2): where their bodies are turned to, discs where they go, 0 while they stand."""
    angle = replay.states["shepherd_angle"][..., None]
    turned = np.concatenate([np.cos(angle), np.sin(angle)], axis=-1)
    return np.where(angle == 0.0, unit(replay.states["shepherd_vel"]), turned)


def _turns(ways: Floats) -> str:
    """Directions (.., 2) as 8-bit numbers, base64: 0 for none, else 1 to 255 round from -pi."""
    angle = np.arctan2(ways[..., 1], ways[..., 0])
    levels = 1 + np.rint((angle + np.pi) / (2 * np.pi) * TURNS) % TURNS
    return base64.b64encode((levels * (ways != 0).any(axis=-1)).astype(np.uint8).tobytes()).decode()


def _episode(replay: Replay, field: tuple[float, float, float]) -> dict[str, Any]:
    x, y, side = field
    step = side / LEVELS
    agents = {}
    for kind in ("sheep", "shepherd"):
        places, velocity = replay.states[f"{kind}_pos"], replay.states[f"{kind}_vel"]
        speed = np.hypot(velocity[..., 0], velocity[..., 1])
        look = replay.states["sheep_heading"] if kind == "sheep" else _looks(replay)
        top = max(float(speed.max(initial=0.0)), 1e-9)
        agents[kind] = {
            "n": places.shape[1],
            "x": _whole(places[..., 0], x - side / 2, step),
            "y": _whole(places[..., 1], y - side / 2, step),
            "speed": _whole(speed, 0.0, top / LEVELS),
            "top_speed": top,
            "look": _turns(look),
            "radius": replay.constants[f"{kind}_radius"].tolist(),
        }
    threatened = np.stack([replay.threatened(t) for t in range(len(replay))])
    state = threatened + 2 * replay.states["sheep_arrived"] + 4 * replay.states["sheep_in_goal"]
    agents["sheep"]["state"] = base64.b64encode(state.astype(np.uint8).tobytes()).decode()
    return {
        "n_steps": replay.n_steps,
        "dt": replay.scenario.control_dt,
        "left": x - side / 2,
        "bottom": y - side / 2,
        "step": step,
        "goal": [*replay.constants["goal_pos"].tolist(), replay.scenario.goal_radius],
        "knows_threat": detection_radius(replay.scenario.flock) > 0,
        "colors": THEME.sheep,
        "states": STATES,
        "shepherd_colors": [_shepherd_color(k) for k in range(replay.n_shepherds)],
        "rewards": {name: values.tolist() for name, values in replay.rewards.items()},
        "reward_colors": [TERMS[k % len(TERMS)] for k in range(len(replay.rewards))],
        "in_goal": replay.in_goal.tolist(),
        "path": np.round(replay.states["shepherd_path"], 2).tolist(),
        "collisions": replay.states["collisions"].tolist(),
        **agents,
    }


def _shepherd_color(k: int) -> str:
    return THEME.shepherds[k % len(THEME.shepherds)]


# --- the plots ---


def _world(replay: Replay, field: tuple[float, float, float]) -> Any:
    """The field: what stands still is drawn here, what moves has sources that the page fills."""
    from bokeh.models import ColumnDataSource, HoverTool, PanTool, Range1d, ResetTool, WheelZoomTool
    from bokeh.plotting import figure

    x, y, side = field
    plot = figure(
        name="world",
        x_range=Range1d(x - side / 2, x + side / 2, name="world_x"),
        y_range=Range1d(y - side / 2, y + side / 2, name="world_y"),
        sizing_mode="stretch_both",
        tools=[PanTool(), wheel := WheelZoomTool(), ResetTool()],
        toolbar_location="above",
        background_fill_color=THEME.ground,
        border_fill_color=None,
        outline_line_color="#C9C5BA",
        output_backend="canvas",
    )
    plot.toolbar.logo = None
    plot.toolbar.active_scroll = wheel
    plot.axis.axis_label_text_font_style = "normal"
    plot.xaxis.axis_label, plot.yaxis.axis_label = "x, m", "y, m"
    plot.grid.grid_line_color = THEME.grid[1]
    _plain(plot)
    goal = replay.constants["goal_pos"].tolist()
    plot.ellipse(
        *goal, width=2 * replay.scenario.goal_radius, height=2 * replay.scenario.goal_radius,
        fill_color=THEME.goal, line_color=THEME.goal_ring, line_width=2,
    )  # fmt: skip
    shapes = [edge(outline) for i, thing in enumerate(replay.obstacles) for outline in outlines(thing, i)]
    plot.patches(
        [shape[:, 0].tolist() for shape in shapes], [shape[:, 1].tolist() for shape in shapes],
        fill_color=THEME.obstacle, line_color=THEME.obstacle, line_width=1, name="obstacles",
    )  # fmt: skip
    trails = ColumnDataSource({"xs": [], "ys": [], "color": []}, name="trails")
    plot.multi_line("xs", "ys", source=trails, line_color="color", line_width=2, line_alpha=0.55)

    moving: dict[str, Any] = {"number": [], "x": [], "y": [], "speed": [], "away": [], "state": [], "color": []}
    moving["radius"] = []
    sheep = ColumnDataSource({**moving}, name="sheep")
    drawn = plot.circle(
        "x", "y", radius="radius", source=sheep, fill_color="color", line_color=THEME.sheep_face, line_width=0.5,
    )  # fmt: skip
    team = ColumnDataSource({**moving}, name="shepherds")
    walking = plot.circle(
        "x", "y", radius="radius", source=team, fill_color="color", line_color=THEME.shepherd_edge, line_width=1.2
    )
    for kind, color in (("sheep", THEME.sheep_face), ("shepherds", THEME.shepherd_edge)):
        faces = ColumnDataSource({"x": [], "y": [], "radius": []}, name=f"{kind}_faces")
        plot.circle("x", "y", radius="radius", source=faces, fill_color=color, line_color=None)
    about = [("at", "@x{0.00}, @y{0.00} m"), ("speed", "@speed{0.00} m/s"), ("to the goal", "@away{0.00} m")]
    plot.add_tools(
        HoverTool(renderers=[drawn], tooltips=[("sheep", "@number"), *about, ("state", "@state")], name="hover_sheep"),
        HoverTool(
            renderers=[walking], tooltips=[("shepherd", "@number"), *about, ("state", "@state")], name="hover_shepherds"
        ),
    )
    return plot


def _rewards(replay: Replay) -> Any:
    """The weighted reward terms against time."""
    plot = _timeline(replay, "rewards", "reward / step")
    plot.xaxis.major_label_text_font_size = "0px"  # the plot below has the same axis
    times = np.arange(1, replay.n_steps + 1) * replay.scenario.control_dt
    for k, (name, values) in enumerate(replay.rewards.items()):
        plot.line(times, values, line_color=TERMS[k % len(TERMS)], line_width=1.6, name=f"term {name}")
    return plot


def _in_goal(replay: Replay) -> Any:
    """Sheep in the goal against time."""
    plot = _timeline(replay, "in_goal", "in the goal")
    times = np.arange(replay.n_steps + 1) * replay.scenario.control_dt
    plot.y_range.start, plot.y_range.end = 0, replay.n_sheep * 1.04
    plot.varea(times, np.zeros(len(times)), replay.in_goal, fill_color=THEME.goal)
    plot.line(times, replay.in_goal, line_color=THEME.goal_ring, line_width=2)
    plot.xaxis.axis_label = "time, s"
    return plot


def _timeline(replay: Replay, name: str, label: str) -> Any:
    """A plot against time, with a cursor that the page moves."""
    from bokeh.models import Range1d, Span
    from bokeh.plotting import figure

    seconds = replay.n_steps * replay.scenario.control_dt
    values = np.concatenate([*replay.rewards.values(), [0.0]])
    room = max(float(np.ptp(values)), 1e-9) * 0.06
    plot = figure(
        name=name,
        x_range=Range1d(0, seconds, name=f"{name}_x"),
        y_range=Range1d(float(values.min()) - room, float(values.max()) + room),
        sizing_mode="stretch_both",
        tools="",
        toolbar_location=None,
        background_fill_color="#FFFFFF",
        border_fill_color=None,
        outline_line_color="#C9C5BA",
        y_axis_label=label,
        min_border_left=72,
        min_border_right=16,
    )
    plot.add_layout(Span(location=0, dimension="height", line_color=THEME.ink, line_width=1.5, name=f"{name}_cursor"))
    plot.axis.axis_label_text_font_style = "normal"
    plot.grid.grid_line_color = THEME.grid[1]
    plot.xaxis.minor_tick_line_color = plot.yaxis.minor_tick_line_color = None
    _plain(plot)
    return plot


def _plain(plot: Any) -> None:
    """The page's letters and colours."""
    for axis in plot.axis:
        axis.axis_label_text_font = axis.major_label_text_font = "system-ui"
        axis.axis_label_text_font_size = axis.major_label_text_font_size = "12px"
        axis.axis_label_text_color = axis.major_label_text_color = THEME.ink
        axis.axis_line_color = axis.major_tick_line_color = "#9A968B"
