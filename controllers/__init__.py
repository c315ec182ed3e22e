"""What moves the shepherds."""

from collections.abc import Callable

from .base import Controller
from .baselines import Idle, Random
from .strombom import StrombomLiteral, StrombomTeam

__all__ = ["CONTROLLERS", "Controller", "Idle", "Random", "StrombomLiteral", "StrombomTeam"]

CONTROLLERS: dict[str, Callable[[], Controller]] = {
    "idle": Idle,
    "random": Random,
    "strombom": StrombomTeam,
    "strombom-literal": StrombomLiteral,
}
"""By name, for the command line; each call makes a fresh one."""
