"""``benchmark --campaign``: the figures hang together, whatever they are."""

import pytest

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
