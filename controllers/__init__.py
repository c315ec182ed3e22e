"""What moves the shepherds."""

from collections.abc import Callable

from .base import Controller
from .baselines import Idle, Random
from .elfiqi import Elfiqi, ElfiqiLiteral
from .learned import POLICIES, Policy, load_policy
from .occlusion import Occlusion
from .pierson import Pierson, PiersonReconstructed
from .strombom import StrombomLiteral, StrombomTeam

__all__ = [
    "CONTROLLERS",
    "POLICIES",
    "Controller",
    "Elfiqi",
    "ElfiqiLiteral",
    "Idle",
    "Occlusion",
    "Pierson",
    "PiersonReconstructed",
    "Policy",
    "Random",
    "StrombomLiteral",
    "StrombomTeam",
    "load_policy",
]

CONTROLLERS: dict[str, Callable[[], Controller]] = {
    "idle": Idle,
    "random": Random,
    "strombom": StrombomTeam,
    "strombom-literal": StrombomLiteral,
    "pierson": Pierson,
    "pierson-reconstructed": PiersonReconstructed,
    "elfiqi": Elfiqi,
    "elfiqi-literal": ElfiqiLiteral,
    "occlusion": Occlusion,
    **POLICIES,
}
"""By name, for the command line; each call makes a fresh one."""
