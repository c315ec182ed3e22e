"""Every Python block of the README and the guide runs, block after block, as a reader would type them."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from shepherd_phys.layouts import Scattered
from shepherd_phys.learning.preset import load_preset
from shepherd_phys.scenario import Scenario, load_scenario

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def blocks(page, language):
    return [body for kind, body in BLOCK.findall(page.read_text(encoding="utf-8")) if kind == language]


@pytest.mark.parametrize("page", [p for p in PAGES if blocks(p, "python")], ids=lambda page: page.name)
def test_python_blocks_run(page, tmp_path):
    script = tmp_path / "page.py"
    script.write_text("\n".join(blocks(page, "python")), encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-P", str(script)], cwd=tmp_path, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr


COMMANDS = [
    (page, line)
    for page in PAGES
    for body in blocks(page, "sh")
    for line in body.splitlines()
    if line.startswith("shepherd-phys ")
]


@pytest.mark.parametrize(("page", "line"), COMMANDS, ids=lambda value: getattr(value, "name", None))
def test_commands_are_understood(page, line, tmp_path):
    """With --help behind them: every name of a command and flag exists."""
    words = line.split("#")[0].split()[1:]
    done = subprocess.run(
        [str(Path(sys.executable).parent / "shepherd-phys"), *words, "--help"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    flags = [word for word in words if word.startswith("--")]
    assert not [flag for flag in flags if flag not in done.stdout]


def test_links_between_pages_lead_somewhere():
    for page in PAGES:
        for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
            assert (page.parent / target).exists(), f"{page.name}: {target}"


@pytest.mark.parametrize("page", ["first-steps.md", "training.md", "extending.md"])
def test_presets_that_are_shown_are_such(page, tmp_path):
    shown = blocks(ROOT / "docs" / page, "toml")[-1]
    (tmp_path / "shown.toml").write_text(shown, encoding="utf-8")
    preset = load_preset(tmp_path / "shown.toml")
    again = tmp_path / "whole.toml"
    preset.to_toml(again)
    assert load_preset(again) == preset
    for name in re.findall(r"^\[?(\w+)", shown, re.MULTILINE):
        assert name in again.read_text(encoding="utf-8")


def test_the_scenario_that_training_shows_is_one(tmp_path):
    discs, _ = blocks(ROOT / "docs/training.md", "toml")
    (tmp_path / "discs.toml").write_text(discs, encoding="utf-8")
    assert load_scenario(tmp_path / "discs.toml") == Scenario(layout=Scattered(count=12))
