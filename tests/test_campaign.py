"""Campaigns lose nothing: whatever dies, hangs, throws, fills up or is killed."""

import errno
import os
import random
import sqlite3
import subprocess
import sys
import time
from pathlib import Path

import campaign_jobs as jobs
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shepherd_phys import campaign, workers
from shepherd_phys.campaign import (
    CampaignError,
    Ledger,
    Task,
    gathered,
    run,
    settings_hash,
    shard,
    write_csv,
    write_parquet,
)


def run_in(folder, todo, work, n_workers, **options):
    with Ledger(folder, "1") as ledger:
        outcome = run(todo, work, workers=n_workers, ledger=ledger, **options)
        write_csv(Path(folder) / "episodes.csv", jobs.COLUMNS, jobs.full_table(todo, outcome))
    return outcome


def ledger_rows(folder):
    with sqlite3.connect(Path(folder) / campaign.LEDGER) as connection:
        found = connection.execute("SELECT settings_hash, seed, row FROM episodes ORDER BY 1, 2").fetchall()
    connection.close()
    return found


# ---- results ------------------------------------------------------------------------------------------------------


def test_rows_do_not_depend_on_the_number_of_workers(tmp_path):
    todo = jobs.tasks(40) + jobs.tasks(5, "b")
    outcomes = [run_in(tmp_path / str(n), todo, jobs.row, n) for n in (0, 1, 2)]
    assert [o.computed for o in outcomes] == [45, 45, 45]
    assert outcomes[0].rows == outcomes[1].rows == outcomes[2].rows == [jobs.row("", task.seed) for task in todo]
    tables = {(tmp_path / str(n) / "episodes.csv").read_bytes() for n in (0, 1, 2)}
    assert len(tables) == 1


def test_a_finished_campaign_costs_nothing_and_a_larger_one_only_the_rest(tmp_path):
    folder = str(tmp_path)
    assert run_in(tmp_path, jobs.tasks(4, folder), jobs.counted_row, 1).computed == 4
    assert run_in(tmp_path, jobs.tasks(4, folder), jobs.counted_row, 1).computed == 0
    assert run_in(tmp_path, jobs.tasks(6, folder), jobs.counted_row, 2).computed == 2
    assert sorted((tmp_path / "calls").read_text().split()) == list("012345")


def test_tasks_given_twice_are_run_once(tmp_path):
    todo = jobs.tasks(3) + jobs.tasks(3)
    with Ledger(tmp_path, "1") as ledger:
        outcome = run(todo, jobs.row, workers=0, ledger=ledger)
    assert outcome.computed == 3
    assert len(outcome.rows) == 3


def test_nothing_to_do(tmp_path):
    outcome = run_in(tmp_path, [], jobs.row, 2)
    assert (outcome.rows, outcome.failures, outcome.computed) == ([], [], 0)
    assert (tmp_path / "episodes.csv").read_text() == ",".join(jobs.COLUMNS) + "\n"


def test_progress_counts_earlier_rows_and_failures(tmp_path):
    seen = []
    run_in(tmp_path, jobs.tasks(2), jobs.row, 0)
    run_in(tmp_path, jobs.tasks(4), jobs.nan_row, 0, report=seen.append, retries=0)
    assert [(p.total, p.done, p.failed) for p in seen] == [(4, 2, 0), (4, 2, 1), (4, 2, 2)]


def test_workers_are_single_threaded_and_the_owners_environment_stays(tmp_path, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    monkeypatch.delenv("NUMBA_NUM_THREADS", raising=False)
    with Ledger(tmp_path, "1") as ledger:
        outcome = run(jobs.tasks(1), jobs.environment_row, workers=1, ledger=ledger)
    assert outcome.rows == [{"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}]
    assert os.environ["OMP_NUM_THREADS"] == "3"
    assert "NUMBA_NUM_THREADS" not in os.environ


def test_what_workers_print_does_not_reach_standard_output(tmp_path, capfd):
    assert run_in(tmp_path, jobs.tasks(1), jobs.noisy_row, 1).computed == 1
    said = capfd.readouterr()
    assert said.out == ""
    assert "nor this" in said.err


# ---- faults -------------------------------------------------------------------------------------------------------


def check_faults(folder, n_tasks, timeout, retries):
    outcome = run_in(folder, jobs.tasks(n_tasks), jobs.faulty_row, 2, timeout=timeout, retries=retries)
    bad = [seed for seed in range(n_tasks) if seed % 10 == 3]
    assert [failure.task.seed for failure in outcome.failures] == bad
    assert {failure.attempts for failure in outcome.failures} == {retries + 1}
    assert [seed for seed, found in enumerate(outcome.rows) if found is None] == bad
    assert [seed for _, seed, _ in ledger_rows(folder)] == [s for s in range(n_tasks) if s not in bad]
    causes = {3: "exit code 0", 13: "exit code 7", 23: "killed by SIGKILL", 33: "hung", 43: "RuntimeError: no luck"}
    for failure in outcome.failures:
        assert causes[failure.task.seed % 50] in failure.cause
        assert f"point a, seed {failure.task.seed}: " in str(failure)
        assert "\n" not in str(failure)


def test_episodes_that_die_hang_or_throw_are_lost_alone(tmp_path):
    check_faults(tmp_path, 50, timeout=0.5, retries=1)


@pytest.mark.slow
def test_a_tenth_of_2000_episodes_goes_wrong(tmp_path):
    check_faults(tmp_path, 2000, timeout=0.5, retries=0)


def test_an_episode_that_fails_once_is_retried(tmp_path):
    outcome = run_in(tmp_path, jobs.tasks(3, str(tmp_path)), jobs.flaky_row, 2)
    assert outcome.failures == []
    assert outcome.computed == 3


def test_a_failed_episode_is_tried_again_by_the_next_run(tmp_path):
    assert len(run_in(tmp_path, jobs.tasks(2), jobs.nan_row, 0).failures) == 2
    assert run_in(tmp_path, jobs.tasks(2), jobs.row, 0).computed == 2


@pytest.mark.parametrize("n_workers", [0, 1])
@pytest.mark.parametrize(
    ("work", "cause"), [(jobs.nan_row, "ValueError: Out of range float"), (jobs.leaving_row, "SystemExit: I leave")]
)
def test_rows_with_nan_and_work_that_leaves_are_failures(tmp_path, n_workers, work, cause):
    outcome = run_in(tmp_path, jobs.tasks(1), work, n_workers, retries=0)
    assert cause in outcome.failures[0].cause
    assert ledger_rows(tmp_path) == []


def test_a_spec_that_cannot_be_read_by_a_worker_is_a_failure_of_its_task(tmp_path):
    todo = [Task("h", 0, Unreadable()), *jobs.tasks(2)]
    with Ledger(tmp_path, "1") as ledger:
        outcome = run(todo, jobs.row, workers=1, ledger=ledger)
    assert [failure.task.settings_hash for failure in outcome.failures] == ["h"]
    assert "ZeroDivisionError" in outcome.failures[0].cause
    assert outcome.computed == 2


class Unreadable:
    def __reduce__(self):
        return divmod, (1, 0)


def test_workers_that_cannot_start_are_one_error(tmp_path, monkeypatch):
    monkeypatch.setattr(workers.pickle, "dumps", lambda work: b"not a pickle")
    with Ledger(tmp_path, "1") as ledger, pytest.raises(CampaignError, match="workers cannot start: UnpicklingError"):
        run(jobs.tasks(2), jobs.row, workers=2, ledger=ledger)


def test_a_script_without_main_guard_is_told_so(tmp_path):
    script = tmp_path / "unguarded.py"
    script.write_text(
        f"import sys; sys.path.insert(0, {str(Path(jobs.__file__).parent)!r})\n"
        f"import campaign_jobs; campaign_jobs.main({str(tmp_path / 'out')!r}, 3, 1)\n"
    )
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=60)
    assert done.returncode != 0
    assert "__main__" in done.stderr.splitlines()[-1]


@pytest.mark.parametrize("bad", [{"workers": -1}, {"workers": 1, "retries": -1}, {"workers": 1, "timeout": 0.0}])
def test_impossible_arguments(tmp_path, bad):
    with Ledger(tmp_path, "1") as ledger, pytest.raises(ValueError, match="cannot be"):
        run(jobs.tasks(1), jobs.row, ledger=ledger, **bad)


# ---- kill -9 of the driver ----------------------------------------------------------------------------------------


def kill_and_continue(folder, n_tasks, kills, seed):
    """Kill the driver at random moments, then let it finish; the table, and the numbers of rows found on the way."""
    chance = random.Random(seed)
    command = [sys.executable, jobs.__file__, str(folder), str(n_tasks), "2"]
    seen = [0]
    for _ in range(kills):
        with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as driver:
            if chance.random() < 0.25:
                time.sleep(chance.uniform(0.0, 0.8))  # while it starts
            else:
                wait_for(lambda driver=driver: count_rows(folder) > seen[-1] or driver.poll() is not None)
                time.sleep(chance.uniform(0.0, 0.1))  # at work
            driver.kill()
        if count_rows(folder):
            with Ledger(folder, "1") as ledger:
                rows = ledger.rows(["hash-a"])
            assert all(found == jobs.row("a", number) for (_, number), found in rows.items())
            assert len(rows) >= seen[-1]  # nothing that was there has gone
            seen.append(len(rows))
    subprocess.run(command, check=True, timeout=300)
    assert [number for _, number, _ in ledger_rows(folder)] == list(range(n_tasks))
    return (Path(folder) / "episodes.csv").read_bytes(), seen


@pytest.mark.parametrize(
    ("n_tasks", "kills"), [(500, 4), pytest.param(10_000, 100, marks=pytest.mark.slow)], ids=["4 kills", "100 kills"]
)
def test_a_killed_driver_loses_and_doubles_nothing(tmp_path, n_tasks, kills):
    run_in(tmp_path / "whole", jobs.tasks(n_tasks), jobs.row, 0)
    table, seen = kill_and_continue(tmp_path / "killed", n_tasks, kills, seed=1)
    assert table == (tmp_path / "whole" / "episodes.csv").read_bytes()
    assert len(set(seen)) > kills / 2  # most kills met it at work


def test_workers_end_with_a_killed_driver(tmp_path):
    command = [sys.executable, jobs.__file__, str(tmp_path), "100000", "2"]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as driver:
        wait_for(lambda: count_rows(tmp_path))
        children = Path(f"/proc/{driver.pid}/task/{driver.pid}/children")
        if not children.exists():
            driver.kill()
            pytest.skip("this system does not list a process's children")
        pids = [int(pid) for pid in children.read_text().split()]
        driver.kill()
    assert len(pids) >= 2
    wait_for(lambda: not any(alive(pid) for pid in pids))


def count_rows(folder):
    """Rows of a ledger that may be in use, or not there yet."""
    if not (Path(folder) / campaign.LEDGER).exists():
        return 0
    connection = sqlite3.connect(Path(folder) / campaign.LEDGER)
    try:
        return connection.execute("SELECT count(*) FROM episodes").fetchone()[0]
    except sqlite3.Error:
        return 0
    finally:
        connection.close()


def alive(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def wait_for(condition):
    for _ in range(1200):
        if condition():
            return
        time.sleep(0.05)
    raise AssertionError("it did not happen")


# ---- the folder ---------------------------------------------------------------------------------------------------


def contents(folder):
    return {path.name: path.read_bytes() for path in Path(folder).iterdir()}


def test_a_folder_in_use(tmp_path):
    with Ledger(tmp_path, "1") as ledger:
        ledger.add(jobs.tasks(1)[0], "{}")
        with pytest.raises(CampaignError, match=f"{tmp_path}: is in use by another run"):
            Ledger(tmp_path, "1")
        done = subprocess.run(
            [sys.executable, jobs.__file__, str(tmp_path), "3", "1"], capture_output=True, text=True, timeout=60
        )
        assert "is in use by another run" in done.stderr
    assert len(ledger_rows(tmp_path)) == 1
    Ledger(tmp_path, "1").close()  # free again


def test_a_ledger_of_another_version_of_the_program(tmp_path):
    run_in(tmp_path, jobs.tasks(3), jobs.row, 0)
    before = contents(tmp_path)
    with pytest.raises(CampaignError, match=r"holds rows of shepherd_phys 1, this is 2"):
        Ledger(tmp_path, "2")
    assert contents(tmp_path) == before


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("PRAGMA user_version = 99", "is a ledger of version 99, this program writes version 1"),
        ("PRAGMA application_id = 5", "is not a ledger of shepherd_phys"),
    ],
)
def test_a_ledger_of_another_schema(tmp_path, change, message):
    run_in(tmp_path, jobs.tasks(3), jobs.row, 0)
    connection = sqlite3.connect(tmp_path / campaign.LEDGER)
    connection.execute(change)
    connection.close()
    before = contents(tmp_path)
    with pytest.raises(CampaignError, match=message):
        Ledger(tmp_path, "1")
    assert contents(tmp_path) == before


def test_a_file_that_is_no_ledger(tmp_path):
    (tmp_path / campaign.LEDGER).write_bytes(b"dear diary" * 100)
    with pytest.raises(CampaignError, match="is not a ledger of shepherd_phys"):
        Ledger(tmp_path, "1")
    assert (tmp_path / campaign.LEDGER).read_bytes() == b"dear diary" * 100
    Ledger(tmp_path / "other", "1").close()


def test_a_folder_that_cannot_be(tmp_path):
    (tmp_path / "file").touch()
    for folder in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(CampaignError, match="cannot be made or written"):
            Ledger(folder, "1")


def test_notes(tmp_path):
    with Ledger(tmp_path, "1") as ledger:
        assert ledger.note("a") is None
        ledger.leave_note("a", "b")
        ledger.leave_note("a", "c")
    with Ledger(tmp_path, "1") as ledger:
        assert ledger.note("a") == "c"


# ---- rows of other folders ----------------------------------------------------------------------------------------


def gather_into(folder, sources, todo):
    taken = gathered([Path(source) for source in sources], "1", todo)
    with Ledger(folder, "1") as ledger:
        ledger.take(taken)
    return taken


def test_shards_gathered_are_the_whole(tmp_path):
    todo = jobs.tasks(11)
    run_in(tmp_path / "whole", todo, jobs.row, 0)
    for i in (1, 2):
        run_in(tmp_path / str(i), shard(todo, i, 2), jobs.row, 0)
    before = [contents(tmp_path / name) for name in "12"]
    assert len(gather_into(tmp_path / "all", [tmp_path / "1", tmp_path / "2"], todo)) == 11
    assert [contents(tmp_path / name) for name in "12"] == before
    assert run_in(tmp_path / "all", todo, jobs.row, 0).computed == 0
    assert (tmp_path / "all" / "episodes.csv").read_bytes() == (tmp_path / "whole" / "episodes.csv").read_bytes()


def test_only_the_rows_asked_for_are_gathered(tmp_path):
    run_in(tmp_path / "a", jobs.tasks(9) + jobs.tasks(2, "b"), jobs.row, 0)
    assert set(gathered([tmp_path / "a"], "1", jobs.tasks(3))) == {("hash-a", seed) for seed in range(3)}


ADD_THREE = """
import os, sys
sys.path.insert(0, sys.argv[1])
import campaign_jobs as jobs
from shepherd_phys.campaign import Ledger
ledger = Ledger(sys.argv[2], "1")
for task in jobs.tasks(3):
    ledger.add(task, "{}")
print("done", flush=True)
sys.stdin.read()
os._exit(1)  # as if it were killed
"""


@pytest.mark.parametrize("then", ["at work", "killed", "killed, and copied without the index"])
def test_rows_that_are_only_in_the_log_of_another_run_are_gathered(tmp_path, then):
    command = [sys.executable, "-c", ADD_THREE, str(Path(jobs.__file__).parent), str(tmp_path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout.readline() == "done\n"
        if then != "at work":
            other.communicate()
        if "without" in then:
            (tmp_path / "ledger.sqlite-shm").unlink()
        before = contents(tmp_path)
        assert before["ledger.sqlite-wal"]
        assert len(gathered([tmp_path], "1", jobs.tasks(3))) == 3
        assert contents(tmp_path) == before


def test_what_cannot_be_gathered_is_one_error_and_changes_nothing(tmp_path):
    todo = jobs.tasks(2)
    run_in(tmp_path / "a", todo, jobs.row, 0)
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / campaign.LEDGER).write_bytes(b"dear diary" * 100)
    Ledger(tmp_path / "c", "2").close()
    for name, message in (
        ("nowhere", "nowhere: has no ledger to gather from"),
        ("b", "is not a ledger of shepherd_phys"),
        ("c", "holds rows of shepherd_phys 2, this is 1"),
    ):
        with pytest.raises(CampaignError, match=message):
            gathered([tmp_path / "a", tmp_path / name], "1", todo)
    assert not (tmp_path / "nowhere").exists()


def test_two_results_of_one_episode_are_an_error_and_nothing_is_taken(tmp_path):
    todo = jobs.tasks(3)
    run_in(tmp_path / "a", todo, jobs.row, 0)
    with Ledger(tmp_path / "b", "1") as ledger:
        ledger.add(todo[2], '{"x": 1}')
    with pytest.raises(CampaignError, match="another result for seed 2 of settings hash-a than was found elsewhere"):
        gathered([tmp_path / "a", tmp_path / "b"], "1", todo)
    with pytest.raises(CampaignError, match="another result for seed 2"):
        gather_into(tmp_path / "b", [tmp_path / "a"], todo)
    assert len(ledger_rows(tmp_path / "b")) == 1


# ---- a full disk --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n_workers", [0, 1])
def test_a_full_disk_stops_the_run_and_the_ledger_stays_good(tmp_path, n_workers):
    todo = jobs.tasks(400)
    with Ledger(tmp_path, "1") as ledger:
        ledger._rows.execute("PRAGMA max_page_count = 8")  # SQLite then fails as on a full disk
        with pytest.raises(CampaignError, match=r"ledger\.sqlite: database or disk is full; every earlier row is kept"):
            run(todo, jobs.row, workers=n_workers, ledger=ledger)
    kept = ledger_rows(tmp_path)
    assert 0 < len(kept) < 400
    outcome = run_in(tmp_path, todo, jobs.row, 0)
    assert outcome.computed == 400 - len(kept)
    assert outcome.rows == [jobs.row("a", seed) for seed in range(400)]


def test_a_table_that_cannot_be_written_leaves_the_old_one(tmp_path, monkeypatch):
    path = tmp_path / "t.csv"
    write_csv(path, ["a"], [{"a": 1}])

    def full(fd):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(CampaignError, match=r"t\.csv: cannot be written \(No space left on device\)"):
        write_csv(path, ["a"], [{"a": 2}])
    assert contents(tmp_path) == {"t.csv": b"a\n1\n"}


@pytest.mark.parametrize("room", [60_000, 200_000])
def test_a_disk_that_fills_up_while_rows_are_written_is_one_error(tmp_path, room):
    """A file may not grow beyond ``room`` bytes; the log of the ledger hits that."""
    code = f"""
import resource, signal, sys
sys.path.insert(0, {str(Path(jobs.__file__).parent)!r})
import campaign_jobs as jobs
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, ({room}, {room}))
from shepherd_phys.campaign import CampaignError, Ledger, run
try:
    with Ledger({str(tmp_path)!r}, "1") as ledger:
        run(jobs.tasks(500), jobs.row, workers=0, ledger=ledger)
except CampaignError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.stderr == ""
    assert f"{tmp_path / campaign.LEDGER}: " in done.stdout
    assert "every earlier row is kept" in done.stdout
    assert done.stdout.count("\n") == 1
    kept = len(ledger_rows(tmp_path))
    assert 0 < kept < 500
    assert run_in(tmp_path, jobs.tasks(500), jobs.row, 0).computed == 500 - kept


def test_a_table_that_lacks_a_column_leaves_nothing_behind(tmp_path):
    with pytest.raises(KeyError):
        write_csv(tmp_path / "t.csv", ["a"], [{"a": 1}, {}])
    assert contents(tmp_path) == {}


def test_seeds_of_63_bits_have_a_place_in_the_ledger(tmp_path):
    task = Task("h", 2**63 - 1, "")
    with Ledger(tmp_path, "1") as ledger:
        ledger.add(task, "{}")
        assert ledger.rows(["h"]) == {task.key: {}}


# ---- plain functions ----------------------------------------------------------------------------------------------


def test_cells(tmp_path):
    write_csv(tmp_path / "t.csv", "abcde", [{"a": 0.1 + 0.2, "b": True, "c": None, "d": 3, "e": "x,y"}])
    assert (tmp_path / "t.csv").read_text() == 'a,b,c,d,e\n0.30000000000000004,true,,3,"x,y"\n'


def test_parquet_has_kinds_and_is_the_same_every_time(tmp_path):
    polars = pytest.importorskip("polars")
    kinds = {"a": float, "b": bool, "c": int, "d": int, "e": str}
    row = {"a": 0.1 + 0.2, "b": True, "c": None, "d": 2**63 - 1, "e": "x,y", "more": 3}
    path = tmp_path / "t.parquet"
    assert write_parquet(path, kinds, [row, {**row, "c": 4}])
    first = path.read_bytes()
    assert write_parquet(path, kinds, [row, {**row, "c": 4}])
    assert path.read_bytes() == first
    frame = polars.read_parquet(path)
    assert frame.rows() == [(0.30000000000000004, True, c, 2**63 - 1, "x,y") for c in (None, 4)]
    assert frame.dtypes == [polars.Float64, polars.Boolean, polars.Int64, polars.Int64, polars.String]
    assert write_parquet(path, kinds, [])
    assert polars.read_parquet(path).schema == frame.schema
    with pytest.raises(CampaignError, match=r"t\.parquet: cannot be written"):
        write_parquet(path, {"e": int}, [row])
    assert list(contents(tmp_path)) == ["t.parquet"]


def test_without_polars_there_is_no_parquet(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "polars", None)
    assert not write_parquet(tmp_path / "t.parquet", {"a": int}, [{"a": 1}])
    assert contents(tmp_path) == {}


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_floats_survive_the_table(number):
    assert float(campaign._cell(number)) == number


@given(st.integers(0, 300), st.integers(1, 20))
def test_shards_are_disjoint_even_and_leave_out_nothing(n, count):
    tasks = [Task(name, 7 * seed, None) for seed in range(n) for name in ("a", "b")]
    parts = [shard(tasks, i, count) for i in range(1, count + 1)]
    assert sorted(task.key for part in parts for task in part) == sorted(task.key for task in tasks)
    assert max(map(len, parts)) - min(map(len, parts)) <= 2
    for part in parts:  # every point has the same seeds
        assert [task.seed for task in part if task.settings_hash == "a"] == [
            task.seed for task in part if task.settings_hash == "b"
        ]


@pytest.mark.parametrize(("number", "count"), [(0, 1), (2, 1), (1, 0), (-1, 3)])
def test_impossible_shards(number, count):
    with pytest.raises(ValueError, match="shard: needs I/N"):
        shard([Task("a", seed, None) for seed in range(5)], number, count)


def test_settings_hash_is_of_the_content():
    assert settings_hash({"a": 1, "b": [1.5, "x"]}) == settings_hash({"b": [1.5, "x"], "a": 1})
    assert settings_hash({"a": 1}) != settings_hash({"a": 2})
    assert len(settings_hash({})) == 64
    with pytest.raises(ValueError, match="Out of range"):
        settings_hash({"a": float("nan")})
