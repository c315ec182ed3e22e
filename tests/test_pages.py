"""The pages of a reproduction, and what the guide shows of one."""

import contextlib
import csv
import json
from pathlib import Path

import pytest

from shepherd_phys.controllers.claims import EXPERIMENTS, judge
from shepherd_phys.controllers.curves import COLUMNS
from shepherd_phys.controllers.evaluation import LABELS
from shepherd_phys.scripts.beyond import PAPER, STUDIES
from shepherd_phys.scripts.curves import VALIDATIONS, read_rows
from shepherd_phys.scripts.learning_pages import ablations_page, figure1_page
from shepherd_phys.scripts.pages import claims_page, figure_page, study_page
from shepherd_phys.scripts.points import points
from shepherd_phys.scripts.studies import HOME_COLUMNS

REPRODUCTION = Path(__file__).parent.parent / "docs" / "reproduction"
LEARNING = {
    "figure1": ["figure1.csv", "figure1-validation.csv", "time-to-home.csv", "figure1.md", "figure1.png"],
    "ablations": ["ablations.csv", "ablations-validation.csv", "ablations.md", "ablations.png"],
}
FILES = [
    *(f"{name}{kind}" for name in EXPERIMENTS for kind in (".csv", "-differences.csv", ".md", ".png")),
    *(name for names in LEARNING.values() for name in names),
    *("claims.json", "claims.md"),
    *(f"{name}.{kind}" for name in STUDIES for kind in ("csv", "md", "png")),
]
LINKED = [name for name in FILES if name.endswith((".md", ".png"))]


def row(controller, n_flocks, cohesion=40, delivered=(90.0, 80.5, 99.0), path=(120.0, 100.4, 140.6)):
    numbers = {}
    for metric, values in (("in_goal_end", delivered), ("path_length", path), ("time_to_95", (61.2, 50.0, 70.9))):
        numbers |= {f"{metric}_{part}": value for part, value in zip(("mean", "low", "high"), values, strict=True)}
    labels = dict(zip(LABELS, (controller, n_flocks, cohesion, 3, 100, "paper"), strict=True))
    return {**labels, "trials": 100, **numbers}


def test_a_figures_page():
    rows = [row("wild", 2, 10), row("wild", 2, 25, (7.04, 0.0, 9.96)), row("mine:A", 2, 25)]
    assert figure_page("figure3", rows).splitlines() == [
        "# Figure 3: varying cohesion",
        "",
        "![Figure 3: varying cohesion; sheep delivered and path length](figure3.png)",
        "",
        "flocks: 2, 3 shepherds, 100 sheep, 100 trials a point; mean [95 % bootstrap interval]; made by "
        "`shepherd-phys reproduce`; claims.json has seed and version.",
        "",
        "**Sheep in the goal at the end, %**",
        "",
        "| controller | n = 10 | n = 25 |",
        "| --- | ---: | ---: |",
        "| `wild` | 90.0 [80.5, 99.0] | 7.0 [0.0, 10.0] |",
        "| `mine:A` |  | 90.0 [80.5, 99.0] |",
        "",
        "**Path of a shepherd, m**",
        "",
        "| controller | n = 10 | n = 25 |",
        "| --- | ---: | ---: |",
        "| `wild` | 120 [100, 141] | 120 [100, 141] |",
        "| `mine:A` |  | 120 [100, 141] |",
        "",
        "**Time until 95 % are in, s (the whole episode where they never were)**",
        "",
        "| controller | n = 10 | n = 25 |",
        "| --- | ---: | ---: |",
        "| `wild` | 61 [50, 71] | 61 [50, 71] |",
        "| `mine:A` |  | 61 [50, 71] |",
    ]


def test_a_figures_page_tells_the_differences_from_the_best():
    numbers = {f"{metric}_diff_{part}": value for metric in ("in_goal_end", "path_length", "time_to_95")
               for part, value in zip(("mean", "low", "high"), (1.26, -2.0, 3.04), strict=True)}  # fmt: skip
    apart = [{"controller": "wild", "n_flocks": 2, "cohesion": n, "baseline": "collie", **numbers} for n in (10, 25)]
    without = figure_page("figure3", [row("wild", 2, 10)]).splitlines()
    told = figure_page("figure3", [row("wild", 2, 10)], apart).splitlines()
    assert told[: len(without)] == without
    assert told[len(without) :][:6] == [
        "",
        "**Sheep in the goal at the end, %: each minus `collie`, paired by trial**",
        "",
        "| controller | n = 10 | n = 25 |",
        "| --- | ---: | ---: |",
        "| `wild` | 1.3 [-2.0, 3.0] | 1.3 [-2.0, 3.0] |",
    ]
    assert [line for line in told if "each minus" in line][1:] == [
        "**Path of a shepherd, m: each minus `collie`, paired by trial**",
        "**Time until 95 % are in, s (the whole episode where they never were): each minus `collie`, paired by trial**",
    ]


def test_a_page_says_where_trials_differ():
    rows = [row("wild", 1), {**row("wild", 2), "trials": 99}]
    assert ", 99 to 100 trials a point; " in figure_page("figure2", rows)


def report(trials, claims):
    return {"trials": trials, "seed": 20_000, "version": "9", "claims": [claim.to_dict() for claim in claims]}


def test_the_claims_page():
    rows = [
        {"controller": "any", "n_flocks": 1, "cohesion": 40, "seed": seed, "in_goal_end": 90.25} for seed in range(3)
    ]
    page = claims_page(report(3, judge(rows, range(3), ["c1", "c6"])))
    lines = page.splitlines()
    assert "3 trials a point on root seed 20000, shepherd_phys 9; values with 95 % bootstrap intervals." in lines
    assert "The claims are stated for 100 trials: verdicts on 3 are a rehearsal." in lines
    assert "| c1 | wild and any deliver at least 95 % with one flock | **fails** |" in lines
    assert "| wild |  | not run | ≥ 95 | undecided |" in lines
    assert "| any | flocks: 1, n = 40 | 90.2 [90.2, 90.2] | ≥ 95 | fails |" in lines
    assert "rehearsal" not in claims_page(report(100, []))


# ---- what the guide shows -------------------------------------------------------------------------------------------


def read(path):
    def value(text):
        for kind in (int, float):
            with contextlib.suppress(ValueError):
                return kind(text)
        return text

    with path.open(newline="") as file:
        return [{name: value(text) for name, text in row.items()} for row in csv.DictReader(file)]


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_the_guides_table_says_what_its_csv_holds(name):
    if not (REPRODUCTION / f"{name}.csv").exists():
        pytest.skip("no results are committed")
    paths = [REPRODUCTION / f"{name}{kind}.csv" for kind in ("", "-differences")]
    tables = [read(path) for path in paths if path.exists()]
    assert (REPRODUCTION / f"{name}.md").read_text("utf-8") == figure_page(name, *tables)
    assert (REPRODUCTION / f"{name}.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_the_guides_results_are_of_the_controllers_and_the_world_as_they_are(name):
    """Whoever changes a parameter of either makes the results anew."""
    if not (REPRODUCTION / f"{name}.csv").exists():
        pytest.skip("no results are committed")
    for row in read(REPRODUCTION / f"{name}.csv"):
        (point,) = points(controllers=[row["controller"]], flocks=[row["n_flocks"]], cohesion=[row["cohesion"]])
        assert point.settings_hash() == row["settings_hash"], str(point)


@pytest.mark.parametrize("name", STUDIES)
def test_the_guides_studies_say_what_their_csvs_hold_of_the_controllers_and_worlds_as_they_are(name):
    if not (REPRODUCTION / f"{name}.csv").exists():
        pytest.skip("no results are committed")
    study = STUDIES[name]
    rows = read(REPRODUCTION / f"{name}.csv")
    told = [{column: None if value == "" else value for column, value in row.items()} for row in rows]
    page = study_page(name, study.title, study.intro, study.baseline, told)
    assert (REPRODUCTION / f"{name}.md").read_text("utf-8") == page
    assert (REPRODUCTION / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    for row in rows:
        (point,) = points(controllers=[row["controller"]], **{**PAPER, **study.cases[row["case"]]})
        assert point.settings_hash() == row["settings_hash"], str(point)


@pytest.mark.parametrize("name", LEARNING)
def test_the_guides_curves_say_what_their_csvs_hold(name):
    if not (REPRODUCTION / f"{name}.csv").exists():
        pytest.skip("no results are committed")
    columns = {"time-to-home.csv": HOME_COLUMNS, f"{name}.csv": COLUMNS, f"{name}-validation.csv": VALIDATIONS}
    tables = [read_rows(REPRODUCTION / file, columns[file]) for file in LEARNING[name] if file.endswith(".csv")]
    page = {"figure1": figure1_page, "ablations": ablations_page}[name]
    assert (REPRODUCTION / f"{name}.md").read_text("utf-8") == page(*tables)
    assert all((REPRODUCTION / file).stat().st_size < 500_000 for file in LEARNING[name])


def test_the_guides_claims_say_what_was_judged():
    if not (REPRODUCTION / "claims.json").exists():
        pytest.skip("no results are committed")
    report = json.loads((REPRODUCTION / "claims.json").read_text("utf-8"))
    assert (REPRODUCTION / "claims.md").read_text("utf-8") == claims_page(report)


def test_the_guide_shows_what_is_committed():
    """Results and links to them come together, and no ledger with them."""
    page = (REPRODUCTION.parent / "reproducing.md").read_text("utf-8")
    committed = {path.name for path in REPRODUCTION.glob("*")}
    assert {name for name in FILES if f"](reproduction/{name})" in page} == committed & set(LINKED)
    assert committed <= {*FILES, "training"}
    policies = {f"{which}.{kind}" for which in ("first", "start") for kind in ("json", "safetensors")}
    kept = {"preset.toml", "curve.csv", "validation.csv", *policies}
    assert {path.name for path in REPRODUCTION.glob("training/*/*")} <= kept
