"""``benchmark --campaign`` and ``--controller``: the figures hang together, whatever they are."""

import pytest

from shepherd_phys.controllers import Idle
from shepherd_phys.scenario import Scenario
from shepherd_phys.scripts import benchmark
from shepherd_phys.scripts.throughput import CONTROLLERS, one_after_another, throughput


@pytest.fixture
def tiny(tmp_path):
    path = tmp_path / "tiny.toml"
    path.write_text("n_sheep = 6\nn_flocks = 2\nshepherds = 2\nn_steps = 6\n")
    return str(path)


def test_one_and_two_workers_are_timed_on_the_same_episodes(tiny, capsys):
    found = throughput(runs=1, n_seeds=2, scenario=tiny)
    assert (found["episodes"], found["runs"]) == (2 * len(CONTROLLERS), 1)
    one, two = found["episodes_per_second_one_worker"], found["episodes_per_second_two_workers"]
    assert found["worker_ratio"] == two / one
    rates = found["episodes_per_second_by_controller"]
    assert tuple(rates) == CONTROLLERS
    # the time of all together is that of the parts
    assert len(CONTROLLERS) / one == pytest.approx(sum(1 / rate for rate in rates.values()))
    assert capsys.readouterr().out == ""


def test_an_episode_that_fails_is_an_error(tiny, monkeypatch):
    monkeypatch.setattr("shepherd_phys.scripts.throughput.one_after_another", fails)
    with pytest.raises(RuntimeError, match="worker 0: ZeroDivisionError"):
        throughput(runs=1, n_seeds=1, scenario=tiny)


def fails(points, seed):
    return 1 / 0


def test_the_work_is_the_episodes_of_all_points(tiny):
    from shepherd_phys.scripts.points import points

    assert one_after_another(points(controllers=["idle", "random"], scenario=tiny), 3) == {"steps": 12}


def test_acting_is_a_part_of_an_episode(monkeypatch):
    monkeypatch.setattr(benchmark, "Scenario", lambda: Scenario(n_sheep=6, n_flocks=2, shepherds=2, n_steps=6))
    found = benchmark.acting(Idle(), n_seeds=2)
    assert 0.0 < found["acting_share"] < 1.0
    seconds = 2 / found["episodes_per_second"]
    assert found["acting_us"] * 12 / 1e6 == pytest.approx(found["acting_share"] * seconds)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--controller", "nobody"], "controllers: 'nobody' is unknown"),
        (["--runs", "0"], "runs: 0 is impossible; it must be at least 1"),
        (["--impacts", "-1"], "impacts: -1 is impossible; it must be at least 0"),
        (["--steps", "many"], "--steps"),
    ],
)
def test_a_mistake_is_one_line(words, said, capsys):
    assert benchmark.main(words) == 2
    error = capsys.readouterr().err
    assert error.startswith("shepherd-phys benchmark: ") and said in error and error.count("\n") == 1
