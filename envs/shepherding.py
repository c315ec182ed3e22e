"""`ShepherdingEnv`, registered as ``Shepherding-v0``: the Gymnasium environment of one team."""

from __future__ import annotations

from collections import deque
from pathlib import Path
from typing import Any, Literal, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from shepherd_phys.camera import Smooth
from shepherd_phys.imperfections import Sight
from shepherd_phys.lidar import Lidar, Scan
from shepherd_phys.observation import Stack
from shepherd_phys.overlays import Corner
from shepherd_phys.palette import THEMES
from shepherd_phys.scenario import Scenario, load_scenario
from shepherd_phys.settings import SettingsError
from shepherd_phys.state import Floats, WorldState
from shepherd_phys.window import Window
from shepherd_phys.world import World

from .outcome import HeldSuccess, measures
from .rewards import Scheme, checked, earned, earning_beams, scans_for


class ShepherdingEnv(gym.Env[NDArray[np.float32], NDArray[np.float32]]):
    """A team of shepherds brings flocks of sheep to a goal region.

    ## Description

    Sheep are discs in a 2-D physics engine; they graze until a shepherd comes within 10 m and then move by the rules
    of Strombom et al. (2014). P shepherds see them by lidar only. One env is one team: an observation row and an
    action row a shepherd, one reward for all. The world is that of "Perception-Based Rewards for Robotic Shepherd
    Teams Maneuvering Split Flocks"; everything about it is set by a `shepherd_phys.scenario.Scenario`.

    ## Action space

    ``Box(-1, 1, (P, 2), float32)``: the wanted velocity of each shepherd over its top speed, world axes (x right,
    y up). Longer than 1 is clipped to the unit disc. It is held for one control step (0.2 s).

    ## Observation space

    ``Box(0, 1, (P, stack x channels, beams), float32)``, by default ``(3, 9, 512)``: the last 3 lidar frames of each
    shepherd, row = frame x channels + channel, newest frame last.

    | channel | reads | range |
    |---|---|---|
    | sheep | the nearest sheep along the beam | 50 m |
    | shepherds | the nearest other shepherd | 50 m |
    | goal | the goal's border (from inside: the way out) | 75 m |
    | obstacles (where the scenario can have some) | the nearest obstacle; it also cuts the other channels | 50 m |

    Beam k points at 2 pi k / 512 from the x axis. A value is 1 - distance / range, 0 where nothing is seen. Fewer
    sectors, the goal frame and the paper's 1536 x 1 x 3 arrangement are settings of `shepherd_phys.lidar.Lidar`. In the
    goal frame observations are rolled by ``beam_offset`` (P,) beams; actions stay in world axes.

    With the scenario's ``imperfections`` beams are lost, ranges noisy, scans late and actions inexact. Rewards and info
    are of the true state and scan all the same.

    ## Rewards

    One number for the team: the sum of weight x term over the scheme. N sheep, T nominal steps.

    | name | weight | term | range of the weighted term over an episode |
    |---|---|---|---|
    | occupy | 10 | sheep in the goal / (N T) | 0 .. 10 |
    | distance | -0.1 | sum over sheep outside of (1 + d) / (N T), d to the border [m] | about -2 .. 0 |
    | occlude | 0.1 | beams with a sheep of S in front of the goal, 2 m to 10 m away / (P T) | 0 .. about 5 |

    Schemes: ``original`` (no occlude), ``any`` (S = all sheep), ``wild`` (S = sheep that have never been in the goal).
    Your own: any mapping name -> (weight, term), see `shepherd_phys.envs.rewards`.

    ## Starting state

    Goal and shepherds are uniform in a 50 m box; each flock's centre lies at a uniform bearing, 10-20 m from the
    goal's.
    ``reset(seed=s)`` replays an episode exactly.

    ## End of an episode

    Truncated by the env itself after T = 1000 steps (do not add a TimeLimit). Terminated only with the
    scenario's ``terminate_on_success``: 95 % of the sheep in the goal for 5 s on end.

    ## Info

    Scalars under the same keys at every step: ``in_goal`` and ``ever_in_goal`` (fractions of the sheep),
    ``path_length`` (mean over the shepherds [m]), ``collisions`` (new contacts since reset), ``is_success`` (95 % in
    now), ``reward/<name>`` (weighted; they add up to the reward), ``share/<name>/<k>`` (shepherd k's own share of a
    term that has shares).

    ## Arguments

    | name | default | what |
    |---|---|---|
    | scenario | ``"paper"`` | a `Scenario`, a preset's name or a TOML file |
    | rewards | ``"wild"`` | a scheme or its name; ``{}``: none is computed and the reward is 0 |
    | lidar | ``"default"`` | a `Lidar`; ``None``: no scan is made and observations are empty, (P, 0) |
    | render_mode | ``None`` | ``"rgb_array"``: pictures; ``"human"``: a window that shows every step at its own pace |
    | render_size | ``(640, 640)`` | width and height of the picture or window in pixels |
    | trail_steps | 150 | control steps of the shepherds' trails in a picture |
    | render_theme | ``"light"`` | or ``"dark"`` |
    | render_beams | ``False`` | whether to draw the beams of the lidar, and those that earn reward |

    ## Version history

    * v0: first release. The version is bumped whenever the same seed and actions may give other results.
    """

    metadata: dict[str, Any] = {"render_modes": ["human", "rgb_array"], "render_fps": 5}  # noqa: RUF012 (Gymnasium's form)

    def __init__(
        self,
        scenario: Scenario | str | Path = "paper",
        rewards: Scheme | str = "wild",
        lidar: Lidar | Literal["default"] | None = "default",
        render_mode: str | None = None,
        render_size: tuple[int, int] = (640, 640),
        trail_steps: int = 150,
        render_theme: Literal["light", "dark"] = "light",
        render_beams: bool = False,
    ) -> None:
        if trail_steps < 0:
            raise SettingsError(f"trail_steps: must not be negative (given: {trail_steps})")
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise SettingsError(f"render_mode: {render_mode!r} is not one of {self.metadata['render_modes']}")
        if render_theme not in THEMES:
            raise SettingsError(f"render_theme: {render_theme!r} is not one of {', '.join(THEMES)}")
        self.scenario = scenario if isinstance(scenario, Scenario) else load_scenario(scenario)
        self.render_mode = render_mode
        self.render_size = render_size
        self.render_theme = render_theme
        self.render_beams = render_beams
        # in step with the world: films and windows show it as fast as it is
        self.metadata = {**self.metadata, "render_fps": max(1, round(1.0 / self.scenario.control_dt))}
        self._camera = Smooth()
        self._corner = Corner()
        self._sums: dict[str, float] = {}
        self._window: Window | None = None
        self._closed_by_hand = False
        self._scheme = checked(rewards)
        if lidar == "default":
            lidar = Lidar(channels=self.scenario.channels)
        if lidar is not None and not isinstance(lidar, Lidar):
            raise SettingsError(f"lidar: needs a Lidar, None or 'default' (given: {lidar!r})")
        self.lidar = lidar
        self.world = World(self.scenario)

        self._scan_lidar, self._sets = scans_for(self._scheme, lidar)
        n_shepherds = self.scenario.n_shepherds
        shape = lidar.observation_shape(n_shepherds) if lidar is not None else (n_shepherds, 0)
        self.observation_space = spaces.Box(0.0, 1.0, shape, np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (n_shepherds, 2), np.float32)
        self.beam_offset = np.zeros(n_shepherds, dtype=np.int64)
        """(P,) beams by which the latest observation is rolled (goal frame; else 0)."""
        self._stack = Stack(lidar) if lidar is not None else None
        self._share_keys = {
            name: [f"share/{name}/{k}" for k in range(n_shepherds)]
            for name, (_, term) in self._scheme.items()
            if hasattr(term, "shares")
        }
        self._held = HeldSuccess()
        self._trails: deque[Floats] = deque(maxlen=trail_steps)
        self._start: Floats | None = None
        self._scan: Scan | None = None

    @property
    def state(self) -> WorldState:
        """The latest state of the world."""
        return self.world.state

    @property
    def user_rng(self) -> np.random.Generator:
        """The stream for controllers and users that ``reset(seed=)`` seeds."""
        return self.world.user_rng

    @property
    def scan(self) -> Scan | None:
        """The latest scan, all beams; None where nothing asks for one."""
        return self._scan

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode: that of ``seed``, or the next one of the generator that an earlier seed started."""
        super().reset(seed=seed)
        if options:
            raise SettingsError(f"options: none are known (given: {sorted(options)})")
        state = self.world.reset(int(self.np_random.integers(2**63)) if seed is None else seed)
        self._held.reset()
        self.beam_offset = np.zeros(self.scenario.n_shepherds, dtype=np.int64)
        self._trails.clear()
        self._start = state.sheep_pos
        self._camera.reset()
        self._corner = Corner()
        self._sums = dict.fromkeys(self._scheme, 0.0)
        self._scan = self._look()
        if self._stack is not None and self.lidar is not None:
            self._stack.reset()
            self._sight = Sight(self.lidar, self.scenario.imperfections, self.world.sensing_rng)
        zeros = {f"reward/{name}": 0.0 for name in self._scheme}
        for keys in self._share_keys.values():
            zeros.update(dict.fromkeys(keys, 0.0))
        info = {**measures(state), **zeros}
        self._held(state, info["is_success"])
        if self.render_mode == "human":
            self.render()
        return self._observe(), info

    def step(self, action: Any) -> tuple[NDArray[np.float32], SupportsFloat, bool, bool, dict[str, Any]]:
        """One control step.

        Raises:
            ValueError: the action has another shape; or, as `NonFiniteError`, holds a NaN or an infinity. Nothing has
                moved then.
        """
        before = self.world.state
        if before.step >= self.scenario.n_steps:
            raise gym.error.ResetNeeded(f"the episode ended after {before.step} steps: call reset")
        after = self.world.step(action)
        if self.render_mode is not None:
            self._trails.append(after.shepherd_pos)
        self._scan = self._look()
        info = measures(after)
        reward = 0.0
        for term in earned(self._scheme, before, after, self._scan, self.scenario):
            info[f"reward/{term.name}"] = term.value
            reward += term.value
            self._sums[term.name] += term.value
            if term.shares is not None:
                info.update(zip(self._share_keys[term.name], term.shares, strict=True))
        held = self._held(after, info["is_success"])
        terminated = self.scenario.terminate_on_success and held
        truncated = after.step >= self.scenario.n_steps
        if self.render_mode == "human":
            self.render()
        return self._observe(), reward, terminated, truncated, info

    def render(self) -> NDArray[np.uint8] | None:
        """A picture (height, width, 3) of the state; None without a render mode, and in the window of "human".

        ``reset`` and ``step`` call it by themselves for "human", at the pace of the world. Closing the window ends the
        showing, not the episode.

        Raises:
            DisplayError: there is no display for a window.
            ImportError: pygame-ce is missing.
        """
        if self.render_mode is None:
            return None
        from shepherd_phys.render import fit, paint

        human = self.render_mode == "human"
        if human and self._closed_by_hand:
            return None
        if human and self._window is None:
            self._window = Window(self.render_size, "Shepherding")
        state = self.world.state
        size = self._window.size if self._window is not None else self.render_size
        canvas = paint(
            state,
            size,
            camera=self._camera(fit(state, size, trails=self._trails), state.time),
            scenario=self.scenario,
            trails=self._trails,
            start=self._start,
            influence_radius=getattr(self.scenario.flock, "detection_radius", None) or None,
            scan=self._scan if self.render_beams else None,
            earning=earning_beams(self._scheme, self._scan) if self.render_beams else None,
            theme=self.render_theme,
            panel=self._corner,
            rewards=self._sums,
        )
        if self._window is None:
            return canvas.picture()
        self._window.show(canvas)
        if any(self._window.asks_to_close(event) for event in self._window.events()):
            self._closed_by_hand = True
            self.close()
        else:
            self._window.wait(self.metadata["render_fps"])
        return None

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.close()
            self._window = None

    def _look(self) -> Scan | None:
        return self.world.scan(self._scan_lidar, self._sets) if self._scan_lidar is not None else None

    def _observe(self) -> NDArray[np.float32]:
        if self.lidar is None or self._stack is None or self._scan is None:
            return np.zeros((self.scenario.n_shepherds, 0), dtype=np.float32)
        self._stack.push(self._sight.frame(self._scan))
        observation, self.beam_offset = self._stack.observe(self.beam_offset)
        return observation
