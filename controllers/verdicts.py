"""What a claim is: numbers with their intervals, each claimed to lie on a side; and when it holds.

A claim has parts, each a number with its 95 % bootstrap interval and the side on which it is claimed to lie. A part
**holds** when its interval lies wholly on that side, **fails** when it lies wholly on the other, and is **undecided**
otherwise, or where the trials that it needs were not all run. A claim holds when all its parts hold and fails when one
fails.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

At = tuple[int, int]
"""A point of the experiments: (flocks, n), with n the neighbours in a sheep's cohesion."""

HOLDS, FAILS, UNDECIDED = "holds", "fails", "undecided"


@dataclass(frozen=True)
class Side:
    """The claimed side: numbers from ``least`` to ``most``, these two included unless ``strict``."""

    least: float = -math.inf
    most: float = math.inf
    strict: bool = False

    def verdict(self, low: float, high: float) -> str:
        """What the interval from ``low`` to ``high`` says; nothing where an end is not a number."""
        if math.isnan(low) or math.isnan(high):
            return UNDECIDED
        if self._holds(low) and self._holds(high):
            return HOLDS
        if high < self.least or low > self.most or (self.strict and (high == self.least or low == self.most)):
            return FAILS
        return UNDECIDED

    def _holds(self, number: float) -> bool:
        return self.least < number < self.most if self.strict else self.least <= number <= self.most

    def __str__(self) -> str:
        if math.isinf(self.most):
            return f"{'>' if self.strict else '≥'} {self.least:g}"
        if math.isinf(self.least):
            return f"{'<' if self.strict else '≤'} {self.most:g}"
        return f"{self.least:g} to {self.most:g}"


@dataclass(frozen=True)
class Part:
    """One number that a claim is about, or the note why there is none."""

    method: str
    side: Side
    rival: str | None = None
    at: At | None = None
    """None: over all n of figure 3."""
    value: float | None = None
    low: float | None = None
    high: float | None = None
    counts: bool = True
    """Whether the claim is about it; otherwise it is reported beside."""
    note: str = ""
    recipe: str | None = None
    """Of the training that it is about, where it is about training."""
    budget: float | None = None
    """Shepherd-steps of that training."""

    @property
    def verdict(self) -> str:
        """Holds, fails or undecided."""
        if self.value is None or self.low is None or self.high is None:
            return UNDECIDED
        return self.side.verdict(self.low, self.high)

    def to_dict(self) -> dict[str, Any]:
        """As plain data; ends at infinity, of the interval and of the side, are None."""
        flocks, n = self.at or (None, None)
        return {
            "method": self.method,
            "rival": self.rival,
            "n_flocks": flocks,
            "cohesion": n,
            "value": self.value,
            "low": _finite(self.low),
            "high": _finite(self.high),
            "claimed": str(self.side),
            "least": _finite(self.side.least),
            "most": _finite(self.side.most),
            "verdict": self.verdict,
            "counts": self.counts,
            "note": self.note,
            "recipe": self.recipe,
            "budget": self.budget,
        }


def _finite(number: float | None) -> float | None:
    return None if number is None or math.isinf(number) else number


@dataclass(frozen=True)
class Claim:
    """A claim with its parts."""

    name: str
    text: str
    statistic: str
    """What the numbers of its parts are."""
    parts: tuple[Part, ...]

    @property
    def verdict(self) -> str:
        """Fails if a part fails, holds if all hold; parts that do not count aside."""
        verdicts = [part.verdict for part in self.parts if part.counts]
        if FAILS in verdicts:
            return FAILS
        return HOLDS if verdicts and set(verdicts) == {HOLDS} else UNDECIDED

    def to_dict(self) -> dict[str, Any]:
        """As plain data."""
        return {
            "claim": self.name,
            "text": self.text,
            "statistic": self.statistic,
            "verdict": self.verdict,
            "parts": [part.to_dict() for part in self.parts],
        }
