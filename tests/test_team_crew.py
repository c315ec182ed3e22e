"""The team's workers: whatever dies, throws or is interrupted, there is one clear error, and nothing is left."""

import inspect
import os
import signal
import subprocess
import sys
import threading

import numpy as np
import pytest
from team_scenes import SMALL, Fails, Slow, Unreadable, episode_seeds

pytest.importorskip("stable_baselines3")

from shepherd_phys.envs._team_crew import shared_out
from shepherd_phys.envs.team import TeamVecEnv, WorkerError


def dead(env):
    """Whether the env says that it is closed, at once."""
    with pytest.raises(WorkerError, match="the vector env is closed"):
        env.reset()


def test_an_error_in_a_worker_is_one_clear_line():
    env = TeamVecEnv(SMALL, (1, 1), rewards={"wolf": (1.0, Fails(4))}, random_clocks=False, n_workers=2)
    env.reset()
    for _ in range(3):
        env.step(np.zeros((2, 2)))
    with pytest.raises(WorkerError) as caught:
        env.step(np.zeros((2, 2)))
    line = inspect.getsourcelines(Fails.__call__)[1] + 4
    seeds = [next(episode_seeds(1_000_000, 0, world)) for world in range(2)]
    assert str(caught.value) in [  # both throw at this step: whoever is read first
        f"worker {i}: ValueError: the wolf came (team_scenes.py:{line}), in world {i}, episode seed {seed}"
        for i, seed in enumerate(seeds)
    ]
    dead(env)


def test_a_worker_that_leaves_is_seen_at_once():
    env = TeamVecEnv(SMALL, (1, 1), rewards={"wolf": (1.0, Fails(2, dies=True))}, random_clocks=False, n_workers=1)
    env.reset()
    env.step(np.zeros((2, 2)))
    with pytest.raises(WorkerError, match="^worker 0 died: exit code 3$"):
        env.step(np.zeros((2, 2)))
    dead(env)


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="no such signal here")
def test_a_worker_that_is_killed_between_two_steps_is_seen():
    env = TeamVecEnv(SMALL, (1, 1), n_workers=2)
    env.reset()
    victim = env._crew._workers[1].process
    os.kill(victim.pid, signal.SIGKILL)
    victim.join(10)
    with pytest.raises(WorkerError, match="^worker 1 died: killed by SIGKILL$"):
        env.step(np.zeros((2, 2)))
    dead(env)


def test_a_worker_that_cannot_start_says_why():
    with pytest.raises(WorkerError, match="^worker 0: ImportError: no such module here"):
        TeamVecEnv(SMALL, (1,), rewards={"odd": (1.0, Unreadable())}, n_workers=1)


@pytest.fixture
def ctrl_c():
    """Python's own answer to SIGINT, which whoever started the tests in the background may have switched off."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("ctrl_c")
def test_ctrl_c_breaks_a_step_off_and_a_reset_goes_on():
    env = TeamVecEnv(SMALL, (1, 1), rewards={"slow": (1.0, Slow(0.5))}, decision_interval=3, n_workers=2)
    try:
        env.reset()
        timer = threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT))
        timer.start()
        with pytest.raises(KeyboardInterrupt):
            env.step(np.zeros((2, 2)))
        timer.join()
        with pytest.raises(RuntimeError, match="perhaps an interrupted one: call step_wait or reset first"):
            env.step_async(np.zeros((2, 2)))
        env.reset()
        assert env.get_attr("decisions") == [0, 0]
        env.step(np.zeros((2, 2)))
        # an interrupted question does not get mixed up with the next one
        timer = threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT))
        timer.start()
        with pytest.raises(KeyboardInterrupt):
            env.env_method("decide", np.zeros((1, 2), np.float32))
        timer.join()
        assert env.get_attr("index") == [0, 1]
    finally:
        env.close()


SCRIPT = """
import numpy as np
from shepherd_phys.envs.team import TeamVecEnv
from shepherd_phys.scenario import Scenario

if __name__ == "__main__":
    scenario = Scenario(n_sheep=6, n_flocks=1, shepherds=1, n_steps=12)
    closed, forgotten = (TeamVecEnv(scenario, (1, 2), n_workers=2) for _ in range(2))
    for env in (closed, forgotten):
        env.reset()
        env.step(np.zeros((3, 2)))
    closed.close()
    forgotten.step_async(np.zeros((3, 2)))
    print("end")
"""


@pytest.mark.slow
def test_nothing_is_left_behind_and_nobody_complains(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    command = [sys.executable, "-P", "-W", "error", str(script)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "end\n", "")


@pytest.mark.slow
def test_a_script_without_its_main_guard_is_told_so(tmp_path):
    script = tmp_path / "script.py"
    script.write_text("from shepherd_phys.envs.team import TeamVecEnv\nTeamVecEnv('small', (1,), n_workers=1)\n")
    done = subprocess.run([sys.executable, "-P", str(script)], capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode != 0
    assert "a script must start its work below: if __name__ == '__main__':" in done.stderr.splitlines()[-1]


def test_worlds_are_shared_out_evenly():
    shares = shared_out((1, 2, 3, 4, 5, 6, 1, 2, 3, 4, 5, 6), 3)
    assert sorted(index for share in shares for index in share) == list(range(12))
    assert {len(share) for share in shares} == {4}
    assert shared_out((1, 1), 5) == [[0], [1]]


def test_workers_do_not_load_a_learning_library(tmp_path):
    code = (
        "import sys, shepherd_phys.envs._team_crew\n"
        "print(*sorted({'torch', 'stable_baselines3', 'pygame', 'matplotlib'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "\n"
