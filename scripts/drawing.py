"""How fast pictures are drawn: of the paper's world at work, 640 x 640 pixels, without a display."""

from __future__ import annotations

import time

import numpy as np

from shepherd_phys.controllers.strombom import StrombomSettings, StrombomTeam
from shepherd_phys.envs import ShepherdingEnv
from shepherd_phys.envs.rewards import WILD, earning_beams
from shepherd_phys.render import draw, fit
from shepherd_phys.scenario import Scenario

TRAIL_STEPS = 150


def drawing(n_pictures: int, seed: int) -> dict[str, float]:
    """Pictures a second of one run, each of the next control step: from one camera, from one that moves, with beams."""
    env = ShepherdingEnv(Scenario(), WILD)
    team = StrombomTeam(StrombomSettings())
    env.reset(seed=seed)
    team.reset(env.user_rng)
    frames = [(env.state, env.scan)]
    for _ in range(TRAIL_STEPS + min(n_pictures, env.scenario.n_steps - TRAIL_STEPS)):
        env.step(team.act(np.empty(0, dtype=np.float32), env.state))
        frames.append((env.state, env.scan))
    places = [state.shepherd_pos for state, _ in frames]
    standing = fit(frames[0][0])
    result = {}
    for name, camera, beams in (("standing", standing, False), ("moving", None, False), ("beams", standing, True)):
        start = time.perf_counter()
        for picture in range(n_pictures):
            k = TRAIL_STEPS + picture % (len(frames) - TRAIL_STEPS)
            state, scan = frames[k]
            draw(
                state,
                camera=camera,
                scenario=env.scenario,
                influence_radius=10.0,
                trails=places[k - TRAIL_STEPS : k],
                start=frames[0][0].sheep_pos,
                scan=scan if beams else None,
                earning=earning_beams(WILD, scan) if beams else None,
            )
        result[f"pictures_per_second_{name}"] = n_pictures / (time.perf_counter() - start)
    return result
