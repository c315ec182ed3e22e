"""Work for test_campaign.py, light to import; as a script, the driver of a campaign that the tests kill."""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path

import numpy as np

from shepherd_phys.campaign import Ledger, Task, run, write_csv

COLUMNS = ("spec", "seed", "x", "n", "even", "settings_hash")


def row(spec, seed):
    """Deterministic numbers, ugly to print."""
    return {"x": float(np.random.default_rng(seed).normal()) * 10.0 ** (seed % 7), "n": seed, "even": seed % 2 == 0}


def slow_row(spec, seed):
    time.sleep(0.003)
    return row(spec, seed)


def faulty_row(spec, seed):
    """A tenth of the seeds goes wrong, in five ways."""
    match seed % 50:
        case 3:
            os._exit(0)
        case 13:
            os._exit(7)
        case 23:
            os.kill(os.getpid(), signal.SIGKILL)
        case 33:
            time.sleep(1000)
        case 43:
            raise RuntimeError(f"no luck\nwith {seed}")
    return row(spec, seed)


def hanging_row(spec, seed):
    if seed == 33:
        time.sleep(1000)
    return row(spec, seed)


def leaving_row(spec, seed):
    sys.exit("I leave")


def flaky_row(spec, seed):
    """Kills its worker at the first attempt and works at the second."""
    mark = Path(spec) / str(seed)
    if not mark.exists():
        mark.touch()
        os._exit(1)
    return row(spec, seed)


def counted_row(spec, seed):
    with (Path(spec) / "calls").open("a") as file:
        file.write(f"{seed}\n")
    return row(spec, seed)


def nan_row(spec, seed):
    return {"x": float("nan")}


def noisy_row(spec, seed):
    print("this must not reach standard output")
    os.write(1, b"nor this\n")
    return row(spec, seed)


def environment_row(spec, seed):
    return {name: os.environ.get(name) for name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS")}


def tasks(n, spec="a"):
    return [Task(f"hash-{spec}", seed, spec, f"point {spec}") for seed in range(n)]


def full_table(todo, outcome):
    return [
        {"spec": task.spec, "seed": task.seed, **found, "settings_hash": task.settings_hash}
        for task, found in zip(todo, outcome.rows, strict=True)
        if found is not None
    ]


def main(folder, n, workers):
    todo = tasks(n)
    with Ledger(folder, "1") as ledger:
        outcome = run(todo, slow_row, workers=workers, ledger=ledger)
        write_csv(Path(folder) / "episodes.csv", COLUMNS, full_table(todo, outcome))


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))
