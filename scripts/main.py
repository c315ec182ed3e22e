"""``shepherd-phys COMMAND ..``: finds the command's file and runs it."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Sequence

from shepherd_phys import __version__

COMMANDS = {
    "evaluate": "run controllers over a grid of experiments and write the tables",
    "watch": "see controllers at work, live in a window or on film, and take a shepherd over",
    "train": "learn a policy, with checkpoints from which a stopped run goes on",
    "tune": "search the lengths of a heuristic team on tuning seeds",
    "benchmark": "measure how fast the simulator is on this machine",
    "plot": "draw results, trajectories, heat maps and learning curves",
    "reproduce": "run the paper's experiments, draw its figures and judge its claims",
}
"""A command is the file of its name in this folder, with ``main(argv) -> exit status``."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; its exit status."""
    try:
        status = _dispatch(list(sys.argv[1:] if argv is None else argv))
        sys.stdout.flush()
        return status
    except KeyboardInterrupt:
        print("shepherd-phys: stopped", file=sys.stderr)
        return 130
    except BrokenPipeError:  # the reader of our output has gone (| head): nothing is wrong
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # for what is still to be flushed
        return 141


def _dispatch(argv: list[str]) -> int:
    name = argv[0] if argv else ""
    if name in ("-h", "--help"):
        print(usage())
        return 0
    if name == "--version":
        print(f"shepherd-phys {__version__}")
        return 0
    if name not in COMMANDS:
        from shepherd_phys.settings import meant  # only now, as below

        problem = f"unknown command {name!r}" if name else "no command"
        there = f"commands are {', '.join(COMMANDS)}{meant(name, COMMANDS)}"
        print(f"shepherd-phys: {problem}; {there} (see --help)", file=sys.stderr)
        return 2
    # imported only now: no command waits for another's libraries
    command = importlib.import_module(f"shepherd_phys.scripts.{name}")
    return int(command.main(argv[1:]))


def usage() -> str:
    """What ``--help`` prints."""
    width = max(map(len, COMMANDS))
    commands = "\n".join(f"  {name:<{width}}  {what}" for name, what in COMMANDS.items())
    return (
        "usage: shepherd-phys COMMAND [OPTIONS]\n\nFast, physics-backed robot shepherding.\n\n"
        f"commands:\n{commands}\n\noptions:\n  --version\n  -h, --help\n\n"
        "'shepherd-phys COMMAND --help' lists a command's options."
    )
