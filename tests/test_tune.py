"""The search for the heuristics' lengths: its record, its repeatability, and the values that stand in the code."""

import tomllib
from pathlib import Path

import pytest

from shepherd_phys import __version__
from shepherd_phys.campaign import Ledger
from shepherd_phys.scripts import tune

RECORDS = Path(__file__).parents[1] / "docs" / "tuning"


@pytest.mark.parametrize("name", tune.TEAMS)
def test_the_values_in_the_code_are_those_that_the_committed_search_found(name):
    record = tomllib.loads((RECORDS / f"{name}.toml").read_text())
    _, tuned, own = tune.TEAMS[name]
    assert record["values"] == tune.lengths(tuned, {**tune.TEAM, **own})
    assert record["score_of_the_best"] >= record["score_of_the_values_before"]


@pytest.mark.parametrize("name", tune.TEAMS)
def test_what_is_searched_holds_the_values_in_the_code(name):
    space = {**tune.TEAM, **tune.TEAMS[name][2]}
    for key, value in tune.lengths(tune.TEAMS[name][1], space).items():
        low, high, _ = space[key]
        assert low <= value <= high, key


def test_a_search_repeats_itself_and_continues_where_it_was(tmp_path, monkeypatch):
    monkeypatch.setattr(tune, "POINTS", ((1, 40, 6),))
    monkeypatch.setattr(tune, "ROUND", (1, 1))
    monkeypatch.setattr(tune, "CONFIRM", 1)
    options = tune.Tune("occlusion", rounds=1, candidates=2, seed=3, workers=2, out=tmp_path / "a")
    with Ledger(options.out, __version__) as ledger:
        path = tune.search(options, ledger)
        first = path.read_bytes()
        rows = dict(ledger._rows.execute("SELECT settings_hash, count(*) FROM episodes GROUP BY 1"))
        # two in the first heat, the better one in the second; then two finalists, one of them perhaps both
        assert sum(rows.values()) in (4, 5)
        monkeypatch.setattr(tune, "episode", None)  # nothing is left to be run
        path.unlink()
        assert tune.search(options, ledger).read_bytes() == first
    record = tomllib.loads(first.decode())
    assert record["command"] == "shepherd-phys tune --controller occlusion --rounds 1 --candidates 2 --seed 3"
    assert record["version"] == __version__
    assert set(record["values"]) == {*tune.TEAM, *tune.TEAMS["occlusion"][2]}


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--controller", "collie"], "controller: 'collie' cannot be tuned; there are strombom, pierson"),
        (["--seed", "20000"], "seed: 20000 is no tuning seed; those are 0 to 9999"),
        (["--rounds", "0"], "rounds: 0 is impossible"),
    ],
)
def test_what_cannot_be_is_one_clear_line(flags, message, tmp_path, capsys):
    assert tune.main([*flags, "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1
    assert not (tmp_path / "out").exists()
