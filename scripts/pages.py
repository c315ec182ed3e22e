"""Markdown pages of a reproduction, from what its CSV and JSON files hold: they can be made again and compared."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from shepherd_phys.controllers.claims import EXPERIMENTS
from shepherd_phys.controllers.summary import WORST

MEASURES = {"in_goal_end": ("Sheep in the goal at the end, %", ".1f"), "path_length": ("Path of a shepherd, m", ".0f")}
LATE = ("Time until 95 % are in, s (the whole episode where they never were)", ".0f")
SHOWN = {"n_flocks": "flocks: {}", "cohesion": "n = {}"}
CLAIMED_TRIALS = 100
"""The paper's trials a point."""


def figure_page(name: str, summary: Sequence[Mapping[str, Any]], differences: Sequence[Mapping[str, Any]] = ()) -> str:
    """The figure with its tables.

    Args:
        name: of `EXPERIMENTS`.
        summary: rows of its CSV.
        differences: rows of the CSV of differences, all from the same baseline; none: not told.
    """
    experiment = EXPERIMENTS[name]
    fixed = "cohesion" if experiment.varied == "n_flocks" else "n_flocks"
    words = {**SHOWN, "n_shepherds": "{} shepherds", "n_sheep": "{} sheep", "trials": "{} trials a point"}
    same = [
        words[label].format(_range(row[label] for row in summary))
        for label in (fixed, "n_shepherds", "n_sheep", "trials")
    ]
    lines = [
        f"# {experiment.title}",
        "",
        f"![{experiment.title}; sheep delivered and path length]({name}.png)",
        "",
        f"{', '.join(same)}; mean [95 % bootstrap interval]; made by `shepherd-phys reproduce`; "
        "claims.json has seed and version.",
    ]
    for metric, (title, digits) in {**MEASURES, "time_to_95": LATE}.items():
        lines += ["", f"**{title}**", "", *_methods_by_point(summary, experiment.varied, metric, digits)]
    for metric, (title, _) in {**MEASURES, "time_to_95": LATE}.items() if differences else ():
        lines += ["", f"**{title}: each minus `{differences[0]['baseline']}`, paired by trial**", ""]
        lines += _methods_by_point(differences, experiment.varied, f"{metric}_diff", ".1f")
    return "\n".join([*lines, ""])


def _methods_by_point(rows: Sequence[Mapping[str, Any]], varied: str, metric: str, digits: str) -> list[str]:
    """A table of one measure: a line a method, a column a point."""
    columns = sorted({row[varied] for row in rows})
    cells = {(row["controller"], row[varied]): _interval(row, f"{metric}_mean", f"{metric}_", digits) for row in rows}
    head = ["controller", *(SHOWN[varied].format(column) for column in columns)]
    return [
        line(head),
        line(["---", *["---:"] * len(columns)]),
        *(
            line([f"`{method}`", *(cells.get((method, column), "") for column in columns)])
            for method in dict.fromkeys(row["controller"] for row in rows)
        ),
    ]


def study_page(name: str, title: str, intro: str, baseline: str | None, summary: Sequence[Mapping[str, Any]]) -> str:
    """The table of a study of worlds that the paper does not have.

    Args:
        name: of its files.
        title: of the page.
        intro: what the cases are.
        baseline: the controller with which the others are compared, if any.
        summary: rows of its CSV.
    """
    trials = _range(row["trials"] for row in summary)
    compared = any(row["ahead_mean"] is not None for row in summary)
    head = ["case", "controller", MEASURES["in_goal_end"][0], "worst episode, %"]
    head += [f"`{baseline}` delivers more by"] if compared else []
    head += [MEASURES["path_length"][0], "95 % in after, s"]
    lines = [
        f"# {title}",
        "",
        f"![{title}; sheep delivered and path length]({name}.png)",
        "",
        f"{intro} {trials} trials a point; mean [95 % bootstrap interval]"
        f"{', differences paired by trial' if compared else ''}; made by `shepherd-phys reproduce {name}`.",
        "",
        line(head),
        line(["---", "---", *["---:"] * (len(head) - 2)]),
    ]
    for row in summary:
        shown = [_interval(row, f"{metric}_mean", f"{metric}_", digits) for metric, (_, digits) in MEASURES.items()]
        ahead = (
            [] if not compared else ["" if row["ahead_mean"] is None else _interval(row, "ahead_mean", "ahead_", ".1f")]
        )
        late = _interval(row, "time_to_95_mean", "time_to_95_", ".0f")
        lines.append(
            line([row["case"], f"`{row['controller']}`", shown[0], f"{row[WORST]:.0f}", *ahead, shown[1], late])
        )
    return "\n".join([*lines, ""])


def claims_page(report: Mapping[str, Any]) -> str:
    """The claims: verdicts, then what each rests on.

    Args:
        report: what ``claims.json`` holds.
    """
    lines = [
        "# The paper's claims",
        "",
        f"{report['trials']} trials a point on root seed {report['seed']}, shepherd_phys {report['version']}; "
        "values with 95 % bootstrap intervals.",
        *few_trials(report),
        "",
        line(["claim", "says", "verdict"]),
        line(["---"] * 3),
    ]
    for claim in report["claims"]:
        lines.append(line([claim["claim"], claim["text"], f"**{claim['verdict']}**"]))
    for claim in report["claims"]:
        lines += ["", f"## {claim['claim']}: {claim['text']}", "", f"{claim['statistic']}; {claim['verdict']}.", ""]
        lines += [line(PART_HEAD), line(["---", "---", "---:", "---", "---"])]
        lines += [line(part_cells(part)) for part in claim["parts"]]
    return "\n".join([*lines, ""])


def few_trials(report: Mapping[str, Any]) -> list[str]:
    """A warning where the claims are judged on fewer trials than they are stated for."""
    if report["trials"] >= CLAIMED_TRIALS:
        return []
    return [f"The claims are stated for {CLAIMED_TRIALS} trials: verdicts on {report['trials']} are a rehearsal."]


PART_HEAD = ("method", "at", "value [95 %]", "claimed", "verdict")


def part_cells(part: Mapping[str, Any]) -> tuple[str, ...]:
    """A part of a claim as cells under `PART_HEAD`."""
    method = part["method"] if part["rival"] is None else f"{part['method']} - {part['rival']}"
    at = "" if part["n_flocks"] is None else f"flocks: {part['n_flocks']}, n = {part['cohesion']}"
    if part["recipe"] is not None:
        at = f"recipe {part['recipe']}"
        if part["budget"] is not None:
            at += f", {part['budget'] / 1e6:.2f} M shepherd-steps"
    digits = ".2f" if 0 in (part["least"], part["most"]) else ".1f"  # a correlation, or percent and metres
    value = part["note"] if part["value"] is None else _interval(part, "value", "", digits)
    verdict = part["verdict"] if part["counts"] else f"({part['verdict']}, beside)"
    return method, at, value, part["claimed"], verdict


def _interval(row: Mapping[str, Any], value: str, prefix: str, digits: str) -> str:
    """A value with its interval, an end of which is None where it is at infinity."""
    low, high = row[f"{prefix}low"], row[f"{prefix}high"]
    ends = "-∞" if low is None else f"{low:{digits}}", "∞" if high is None else f"{high:{digits}}"
    return f"{row[value]:{digits}} [{', '.join(ends)}]"


def _range(values: Iterable[Any]) -> str:
    found = sorted(set(values))
    return str(found[0]) if len(found) == 1 else f"{found[0]} to {found[-1]}"


def line(cells: Sequence[str]) -> str:
    """Cells as a line of a table."""
    return f"| {' | '.join(cells)} |"
