"""`Player`: shows sources of frames side by side, and does what keys and mouse ask for. It opens no window itself."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from shepherd_phys.camera import Camera, Size, Smooth, fit
from shepherd_phys.canvas import Canvas, pygame_ce
from shepherd_phys.lidar import Scan
from shepherd_phys.overlays import Corner, draw_note, draw_table
from shepherd_phys.palette import THEMES
from shepherd_phys.render import paint
from shepherd_phys.replay import detection_radius
from shepherd_phys.state import Floats, WorldState, frozen

from .sources import Frame, Source, between

SPEEDS = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
"""Seconds of the world in a second of the watcher's."""
CAMERAS = ("fit", "follow", "fixed")
"""All in sight; the chosen shepherd, or the sheep, in the middle; where the episode began."""
BUSY_SECONDS = 0.1
"""A picture is shown at least so often, however slow the world: it then falls behind the asked speed."""
TRAIL_SECONDS = 30.0
FOLLOW_WIDTH = 30.0
"""[m]"""
MARGIN = 0.12
"""Free border of a picture that keeps all in sight, as a fraction: the panel and a camera that lags need some."""
GRASP = 24.0
"""[px]: a press so near to a shepherd means this one."""
SLOWING = 1.0
"""[m]: nearer to the pointer than this, a shepherd that is led there slows down."""
HELP = (
    ("space", "pause, go on"),
    (".", "one step"),
    ("+  -", "faster, slower"),
    ("N", "next episode"),
    ("R", "this episode again"),
    ("Tab  1-9", "choose a shepherd"),
    ("arrows  W A S D", "lead it"),
    ("mouse, held", "lead it to the pointer"),
    ("G  Esc", "give it back"),
    ("B", "beams: all, chosen, none"),
    ("I", "influence radius"),
    ("C", "camera: fit, follow, fixed"),
    ("wheel", "nearer, farther"),
    ("L", "light, dark"),
    ("H", "these keys"),
    ("Q", "quit"),
)


class View:
    """One source on its part of the picture: where it stands between two frames, its trails and its camera."""

    def __init__(self, source: Source) -> None:
        self.source = source
        self.camera = Smooth()
        self.restart()

    def restart(self, *, onward: bool = False) -> None:
        """Begin the episode, or the next one."""
        self.now = self.before = self.source.restart(onward=onward)
        self.start = self.now.state.sheep_pos
        self.first = self.now.state
        self.progress = 0.0
        steps = max(1, round(TRAIL_SECONDS / self.source.scenario.control_dt))
        self.trails: deque[Floats] = deque(maxlen=steps)
        self.camera.reset()
        self.corner = Corner()

    def advance(self, taken: dict[int, Floats]) -> None:
        """One control step, if there is one left."""
        if not self.now.over:
            self.before = self.now
            self.trails.append(self.before.state.shepherd_pos)
            self.now = self.source.advance(taken)

    def state(self, *, smooth: bool) -> WorldState:
        """What is to be seen now; not ``smooth``: a state that was, the latest."""
        if not smooth or self.now.over or self.before is self.now:
            return self.now.state
        return between(self.before.state, self.now.state, self.progress)


class Player:
    """The state of a showing. `handle` takes events of pygame, `tick` lets time pass, `canvas` is what it looks like.

    Args:
        sources: what is to be seen, side by side.
        size: (w, h) of the whole [px]; may be changed at any time.
        theme: light or dark.
        speed: seconds of the world in a second.
        beams: "none", "all", or "chosen": those of the chosen shepherd.
        camera: one of `CAMERAS`.
        keys: whether to tell how to see the keys.

    Attributes:
        paused, speed, theme, beams, camera, influence, help: what they say.
        chosen: (view, shepherd) of the one that is chosen, or None.
        taken: whether the chosen one is led by hand.
        running: False once somebody has quit.
    """

    def __init__(
        self,
        sources: Sequence[Source],
        size: Size,
        *,
        theme: Literal["light", "dark"] = "light",
        speed: float = 1.0,
        beams: Literal["none", "all", "chosen"] = "none",
        camera: str = "fit",
        keys: bool = True,
    ) -> None:
        self.views = [View(source) for source in sources]
        self.size = size
        self.theme: Literal["light", "dark"] = theme
        self.speed, self.beams, self.camera = speed, beams, camera
        self.paused = self.help = self.taken = False
        self.influence = self.running = True
        self.chosen: tuple[int, int] | None = None
        self._tells_keys = keys
        self._held: set[str] = set()
        self._pointer: tuple[float, float] | None = None
        self._zoom = 1.0
        self._clock = 0.0

    # ------------------------------------------------------------------- time

    @property
    def over(self) -> bool:
        """Whether all episodes have ended."""
        return all(view.now.over for view in self.views)

    def seconds_to(self, step: int) -> float:
        """The watcher's time until the first of the views has made so many control steps [s]; a hair more."""
        ways = [
            (step - view.now.state.step - view.progress + 1e-9) * view.source.scenario.control_dt
            for view in self.views
            if not view.now.over
        ]
        done = max(view.now.state.step for view in self.views) >= step
        return 0.0 if done or not ways else min(ways) / self.speed

    def tick(self, seconds: float) -> None:
        """Let ``seconds`` of the watcher's time pass."""
        self._clock += seconds
        if self.paused:
            return
        self._clock += seconds * self.speed  # the faster the world, the faster the camera must be
        begun = time.monotonic()
        for view in self.views:
            view.progress += seconds * self.speed / view.source.scenario.control_dt
        while any(view.progress >= 1.0 and not view.now.over for view in self.views):
            for k, view in enumerate(self.views):
                if view.progress >= 1.0:
                    view.progress -= 1.0
                    view.advance(self._orders(k))
            if time.monotonic() - begun > BUSY_SECONDS:
                for view in self.views:
                    view.progress %= 1.0
                break

    def step(self) -> None:
        """One control step of every view; then stand still."""
        self.paused = True
        for k, view in enumerate(self.views):
            view.advance(self._orders(k))
            view.progress = 0.0

    def restart(self, *, onward: bool = False) -> None:
        """Begin the episodes again, or the next ones."""
        for view in self.views:
            view.restart(onward=onward)
        self.give_back()

    # ------------------------------------------------------------------ hands

    def choose(self, view: int, shepherd: int) -> None:
        """Choose a shepherd; another one that was led goes back to its controller."""
        if self.chosen != (view, shepherd):
            self.give_back()
            self.chosen = view, shepherd

    def take(self) -> None:
        """Lead the chosen shepherd, the first one where none is, by hand, where the source lets one."""
        team = next((k for k, view in enumerate(self.views) if view.now.state.n_shepherds), None)
        if self.chosen is None and team is not None:
            self.chosen = team, 0
        self.taken = self.chosen is not None and self.views[self.chosen[0]].source.steerable

    def give_back(self) -> None:
        """Let the controller lead it again."""
        self.taken = False
        self._pointer = None

    def _orders(self, view: int) -> dict[int, Floats]:
        """The action (2,) of the shepherd that is led, if it is in this view."""
        if not self.taken or self.chosen is None or self.chosen[0] != view:
            return {}
        shepherd = self.chosen[1]
        if self._pointer is not None:
            way = self._world(view, self._pointer) - self.views[view].now.state.shepherd_pos[shepherd]
            return {shepherd: way / max(float(np.hypot(*way)), SLOWING)}
        x = ("right" in self._held) - ("left" in self._held)
        y = ("up" in self._held) - ("down" in self._held)
        return {shepherd: np.array([x, y], dtype=float) / max(float(np.hypot(x, y)), 1.0)}

    # ----------------------------------------------------------------- events

    def handle(self, event: Any) -> None:
        """Do what an event of pygame asks for."""
        pygame = pygame_ce()
        if event.type == pygame.QUIT:
            self.running = False
        elif event.type == pygame.KEYDOWN:
            self._press(pygame.key.name(event.key))
        elif event.type == pygame.KEYUP:
            self._held.discard(_WAYS.get(pygame.key.name(event.key), ""))
        elif event.type == pygame.WINDOWFOCUSLOST:  # what is let go now is not told
            self._held.clear()
        elif event.type == pygame.MOUSEBUTTONDOWN and event.button == 1:
            self._grasp(event.pos)
        elif event.type == pygame.MOUSEMOTION and self._pointer is not None:
            self._pointer = event.pos
        elif event.type == pygame.MOUSEBUTTONUP and event.button == 1:
            self._pointer = None
        elif event.type == pygame.MOUSEWHEEL:
            self._zoom = float(np.clip(self._zoom * 0.9**event.y, 0.1, 10.0))

    def _press(self, key: str) -> None:
        if key in _WAYS:
            self._held.add(_WAYS[key])
            self.take()
        elif key == "space":
            self.paused = not self.paused
        elif key in (".", "[.]"):
            self.step()
        elif key in ("+", "=", "[+]", "-", "[-]"):
            at = int(np.argmin(np.abs(np.log(np.array(SPEEDS) / self.speed)))) + (-1 if "-" in key else 1)
            self.speed = SPEEDS[min(max(at, 0), len(SPEEDS) - 1)]
        elif key in ("n", "r"):
            self.restart(onward=key == "n")
        elif key in ("g", "escape"):
            self.give_back()
            self.help = False
        elif key == "tab" or key.strip("[]").isdecimal():
            self._choose_by(key.strip("[]"))
        elif key == "b":
            self.beams = _after(self.beams, ("none", "all", "chosen") if self.chosen is not None else ("none", "all"))
        elif key == "c":
            self.camera = _after(self.camera, CAMERAS)
        elif key == "l":
            self.theme = "light" if self.theme == "dark" else "dark"
        elif key == "i":
            self.influence = not self.influence
        elif key == "h":
            self.help = not self.help
        elif key == "q":
            self.running = False

    def _choose_by(self, key: str) -> None:
        team = [(k, p) for k, view in enumerate(self.views) for p in range(view.now.state.n_shepherds)]
        if key == "tab" and team:
            self.choose(*team[(team.index(self.chosen) + 1) % len(team) if self.chosen in team else 0])
        elif key != "tab":
            wanted = (self.chosen[0] if self.chosen is not None else 0), int(key) - 1
            if wanted in team:
                self.choose(*wanted)

    def _grasp(self, at: tuple[float, float]) -> None:
        """Lead a shepherd to the pointer: the one pressed on, else the chosen one of this view, else the nearest."""
        k = min(int(at[0] // self._part[0]), len(self.views) - 1)
        view = self.views[k]
        if not view.now.state.n_shepherds:
            return
        left = k * self._part[0]
        camera = self._cameras()[k]
        pixels = camera.to_pixels(view.now.state.shepherd_pos, self._part) + np.array([left, 0])
        apart = np.hypot(*(pixels - at).T)
        if apart.min() <= GRASP or self.chosen is None or self.chosen[0] != k:
            self.choose(k, int(apart.argmin()))
        self.take()
        self._pointer = at

    # --------------------------------------------------------------- pictures

    @property
    def _part(self) -> Size:
        """(w, h) of one view."""
        return self.size[0] // len(self.views), self.size[1]

    def _world(self, view: int, pixel: tuple[float, float]) -> Floats:
        """The place in the world (2,) [m] under a pixel of the whole."""
        return self._cameras()[view].to_world((pixel[0] - view * self._part[0], pixel[1]), self._part)

    def _states(self) -> list[WorldState]:
        # a scan is of a state that was, not of one between
        return [view.state(smooth=self.beams == "none" and not self.paused) for view in self.views]

    def _cameras(self) -> list[Camera]:
        return [
            view.camera(self._aim(k, state), self._clock)
            for k, (view, state) in enumerate(zip(self.views, self._states(), strict=True))
        ]

    def _aim(self, k: int, state: WorldState) -> Camera:
        if self.camera == "follow":
            own = self.chosen[1] if self.chosen is not None and self.chosen[0] == k else None
            x, y = (state.sheep_pos.mean(axis=0) if own is None else state.shepherd_pos[own]).tolist()
            width = FOLLOW_WIDTH
        else:
            aim = fit(self.views[k].first if self.camera == "fixed" else state, self._part, margin=MARGIN)
            (x, y), width = aim.center, aim.width
        return Camera(center=(x, y), width=width * self._zoom)

    def canvas(self) -> Canvas:
        """What it looks like now."""
        whole = Canvas(self.size, THEMES[self.theme].ground)
        for k, (view, state, camera) in enumerate(zip(self.views, self._states(), self._cameras(), strict=True)):
            chosen = self.chosen[1] if self.chosen is not None and self.chosen[0] == k else None
            scan, earning = self._beams(view.now, chosen)
            part = paint(
                state,
                self._part,
                camera=camera,
                scenario=view.source.scenario,
                trails=list(view.trails),
                influence_radius=(detection_radius(view.source.scenario.flock) or None) if self.influence else None,
                start=view.start,
                scan=scan,
                earning=earning,
                chosen=chosen,
                theme=self.theme,
                panel=view.corner,
                rewards=view.now.rewards,
                title=f"{view.source.name}\n{view.source.label}",
            )
            whole.paste(part, k * self._part[0], 0)
            if k:
                whole.box(THEMES[self.theme].faint_ink, k * self._part[0] - 1, 0, 2, self.size[1])
        if self._tells_keys:
            self._tell(whole)
        return whole

    def _beams(self, frame: Frame, chosen: int | None) -> tuple[Scan | None, Floats | None]:
        if self.beams == "none" or frame.scan is None:
            return None, None
        if self.beams == "all":
            return frame.scan, frame.earning
        shown = np.arange(frame.state.n_shepherds)[:, None] == chosen
        scan = Scan(frame.scan.names, frozen(np.where(shown, frame.scan.ranges, np.inf)))
        return scan, None if frame.earning is None else np.where(shown, frame.earning, np.inf)

    def _tell(self, whole: Canvas) -> None:
        theme = THEMES[self.theme]
        if self.help:
            draw_table(whole, HELP, theme)
        told = ["the end: N next, R again"] if self.over else ["paused"] if self.paused else []
        told.append(f"{self.speed:g}x")
        if self.chosen is not None:
            told.append(f"{'you lead' if self.taken else 'chosen:'} shepherd {self.chosen[1] + 1}")
        draw_note(whole, "   ".join([*told, "H: keys"]), theme)


_WAYS = {
    **{way: way for way in ("up", "down", "left", "right")},
    **{"w": "up", "s": "down", "a": "left", "d": "right"},
}
"""The direction that a key stands for."""


def _after(value: Any, values: tuple[Any, ...]) -> Any:
    return values[(values.index(value) + 1) % len(values)] if value in values else values[0]
