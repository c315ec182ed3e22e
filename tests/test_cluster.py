"""Campaigns on a real Dask cluster of processes on this machine: a scheduler, workers, and what becomes of them."""

import json
import os
import signal
import socket
import subprocess
import sys
from functools import partial
from pathlib import Path

import campaign_jobs as jobs
import pytest
from test_campaign import count_rows, ledger_rows, run_in, wait_for

from shepherd_phys import __version__, cluster
from shepherd_phys.campaign import CampaignError, Ledger, run
from shepherd_phys.cluster import Cluster

pytest.importorskip("distributed", reason="needs the extra cluster")
TESTS = str(Path(__file__).parent)
CHASE = """
import numpy as np

class Chase:
    lidar = None
    def reset(self, rng): pass
    def act(self, observation, state): return np.clip(state.sheep_pos.mean(axis=0) - state.shepherd_pos, -1.0, 1.0)
"""


class Dask:
    """Processes of Dask's own commands, all ended at the end."""

    def __init__(self, folder):
        self.folder = folder
        self.processes = []

    def start(self, name, *words, path=TESTS):
        environment = {**os.environ, "PYTHONPATH": path}
        with (self.folder / "dask.log").open("a") as log:
            process = subprocess.Popen(
                [sys.executable, "-m", f"distributed.cli.dask_{name}", *words, "--host", "127.0.0.1"],
                stdout=log,
                stderr=log,
                env=environment,
                cwd=self.folder,
            )
        self.processes.append(process)
        return process

    def scheduler(self):
        file = self.folder / f"scheduler{len(self.processes)}.json"
        process = self.start("scheduler", "--port", "0", "--no-dashboard", "--scheduler-file", str(file))
        wait_for(lambda: file.exists() and file.read_text())
        self.address = json.loads(file.read_text())["address"]
        return process

    def worker(self, *, path=TESTS, threads=1, nanny=False):
        """A nanny watches a worker and begins it anew; it makes it slower to start and to end."""
        words = ["--local-directory", str(self.folder), "--nanny" if nanny else "--no-nanny"]
        return self.start("worker", self.address, "--nthreads", str(threads), "--no-dashboard", *words, path=path)

    def end(self):
        for process in self.processes:
            process.kill()  # the worker of a nanny ends with it; a polite end waits for others that end, too
            process.wait()


@pytest.fixture
def dask(tmp_path):
    found = Dask(tmp_path)
    found.scheduler()
    yield found
    found.end()


def on(dask, said=None):
    return partial(Cluster, address=dask.address, say=[].append if said is None else said)


def whole(tmp_path, todo):
    run_in(tmp_path / "whole", todo, jobs.row, 0)
    return (tmp_path / "whole" / "episodes.csv").read_bytes()


@pytest.mark.slow
def test_a_killed_worker_loses_nothing(tmp_path, dask):
    todo = jobs.tasks(80)
    workers = [dask.worker() for _ in range(2)]
    killed = []

    def kill_one(progress):
        if progress.done > 20 and not killed:
            killed.append(workers[0].send_signal(signal.SIGKILL))

    outcome = run_in(tmp_path / "cluster", todo, jobs.slow_row, on(dask), report=kill_one)
    assert killed and workers[0].wait(20) == -signal.SIGKILL
    assert (outcome.failures, outcome.computed) == ([], 80)
    assert (tmp_path / "cluster" / "episodes.csv").read_bytes() == whole(tmp_path, todo)


@pytest.mark.slow
def test_episodes_that_die_or_throw_are_lost_alone(tmp_path, dask):
    todo = [task for task in jobs.tasks(50) if task.seed < 8 or task.seed == 43]
    for _ in range(2):
        dask.worker(nanny=True)
    outcome = run_in(tmp_path / "cluster", todo, jobs.faulty_row, on(dask), retries=1)
    assert [failure.task.seed for failure in outcome.failures] == [3, 43]
    for failure, cause in zip(outcome.failures, ["worker died", "RuntimeError: no luck with 43"], strict=True):
        assert cause in failure.cause
        assert failure.attempts == 2
    assert [seed for _, seed, _ in ledger_rows(tmp_path / "cluster")] == [0, 1, 2, 4, 5, 6, 7]


@pytest.mark.slow
@pytest.mark.parametrize("nanny", [True, False], ids=["nanny", "none"])
def test_an_episode_that_hangs_is_lost_alone(tmp_path, dask, nanny):
    todo = [task for task in jobs.tasks(40) if task.seed > 28]
    dask.worker(threads=2, nanny=nanny)
    if not nanny:
        dask.worker()  # the other one is not begun anew
    outcome = run_in(tmp_path / "cluster", todo, jobs.hanging_row, on(dask), timeout=10.0, retries=0)
    assert [(failure.task.seed, failure.cause) for failure in outcome.failures] == [(33, "hung: no end after 10 s")]
    assert outcome.computed == 10


def test_an_empty_cluster_is_waited_for_with_a_message(tmp_path, dask):
    said = []

    def say(text):
        said.append(text)
        if len(said) == 1:
            dask.worker()

    outcome = run_in(tmp_path / "cluster", jobs.tasks(5), jobs.row, on(dask, say))
    assert said[0] == f"scheduler {dask.address} has no workers; waiting for one to join"
    assert outcome.rows == [jobs.row("a", seed) for seed in range(5)]


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("__version__ = '0.0.0'", f"it has shepherd_phys 0.0.0, this is {__version__}"),
        ("raise ImportError('not here')", "shepherd_phys is missing (not here)"),
        (None, "ModuleNotFoundError: No module named 'campaign_jobs'"),
    ],
    ids=["other version", "missing", "user's module"],
)
def test_workers_that_cannot_do_the_work_are_one_error(tmp_path, dask, source, message):
    if source is not None:
        (tmp_path / "stub" / "shepherd_phys").mkdir(parents=True)
        (tmp_path / "stub" / "shepherd_phys" / "__init__.py").write_text(source)
    dask.worker(path=str(tmp_path / "stub"))
    wait_for(lambda: "Starting established connection" in (tmp_path / "dask.log").read_text())
    with pytest.raises(CampaignError, match="cannot do the work") as problem:
        run_in(tmp_path / "cluster", jobs.tasks(5), jobs.row, on(dask))
    assert message in str(problem.value)
    assert "\n" not in str(problem.value)
    assert ledger_rows(tmp_path / "cluster") == []


def test_a_scheduler_that_dies_is_one_error_and_the_same_run_continues(tmp_path, dask, capfd):
    todo = jobs.tasks(60)
    dask.worker()

    def kill(progress):
        if progress.done == 20:
            dask.processes[0].kill()

    with pytest.raises(CampaignError, match=f"connection to {dask.address} is lost; what was finished is kept"):
        run_in(tmp_path / "cluster", todo, jobs.slow_row, on(dask), report=kill)
    assert capfd.readouterr().err == ""
    kept = count_rows(tmp_path / "cluster")
    assert 20 <= kept < 60
    assert run_in(tmp_path / "cluster", todo, jobs.row, 0).computed == 60 - kept
    assert (tmp_path / "cluster" / "episodes.csv").read_bytes() == whole(tmp_path, todo)


@pytest.mark.parametrize("kind", ["nobody", "somebody else", "nonsense"])
def test_a_scheduler_that_is_not_there_is_one_error(tmp_path, monkeypatch, capfd, kind):
    monkeypatch.setattr(cluster, "CONNECT_SECONDS", 1.0)
    with socket.socket() as listener, Ledger(tmp_path, "1") as ledger:
        listener.bind(("127.0.0.1", 0))
        if kind == "somebody else":
            listener.listen()
        address = "non sense:x" if kind == "nonsense" else "tcp://{}:{}".format(*listener.getsockname())
        with pytest.raises(CampaignError, match=f"scheduler: {address} cannot be reached") as problem:
            run(jobs.tasks(2), jobs.row, workers=partial(Cluster, address=address, say=print), ledger=ledger)
    assert "\n" not in str(problem.value)
    said = capfd.readouterr()
    assert (said.out, said.err) == ("", "")


def test_without_dask_the_error_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    hire = partial(Cluster, address="tcp://127.0.0.1:1", say=print)
    with Ledger(tmp_path, "1") as ledger, pytest.raises(CampaignError, match=r"pip install 'shepherd-phys\[cluster\]'"):
        run(jobs.tasks(2), jobs.row, workers=hire, ledger=ledger)


def test_a_finished_campaign_needs_no_cluster(tmp_path):
    run_in(tmp_path, jobs.tasks(3), jobs.row, 0)
    assert run_in(tmp_path, jobs.tasks(3), jobs.row, partial(Cluster, address="nowhere:1", say=print)).computed == 0


def test_evaluate_on_a_cluster_writes_the_same_tables(tmp_path, dask):
    """With several threads in a worker, whose episodes must not touch one another."""
    (tmp_path / "tiny.toml").write_text("n_sheep = 8\nn_flocks = 2\nshepherds = 2\nn_steps = 40\n")
    (tmp_path / "mine.py").write_text(CHASE)
    words = [
        "evaluate",
        "--scenario",
        "tiny.toml",
        "--controllers",
        "strombom",
        "random",
        "mine:Chase",
        "--trials",
        "6",
    ]
    path = os.pathsep.join([TESTS, str(tmp_path)])
    dask.worker(threads=3, path=path)
    for out, how in (("here", ["--workers", "1"]), ("there", ["--scheduler", dask.address])):
        command = [Path(sys.executable).with_name("shepherd-phys"), *words, *how, "--out", out]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=600)
        assert done.returncode == 0, done.stderr
        # a slow machine's progress and a worker that has not started yet are worth a line; Dask's own words are not
        said = [line for line in done.stderr.splitlines() if " episodes: " not in line]
        assert all(line.startswith("shepherd-phys evaluate: ") and "waiting" in line for line in said), said
    names = sorted(path.name for path in (tmp_path / "here").iterdir() if not path.name.startswith("ledger"))
    assert "episodes.csv" in names
    for name in names:
        assert (tmp_path / "there" / name).read_bytes() == (tmp_path / "here" / name).read_bytes()
