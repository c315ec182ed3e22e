"""The guide: it is built without a warning, and its first steps lead where they say."""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"


@pytest.mark.slow
def test_the_guide_is_built_without_a_warning(tmp_path):
    pytest.importorskip("furo")
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "--quiet", "-d", str(tmp_path / "trees")]
    done = subprocess.run(
        [*command, str(DOCS), str(tmp_path / "html")], capture_output=True, text=True, timeout=1800, check=False
    )
    assert done.returncode == 0, done.stderr
    for page in DOCS.glob("*.md"):
        assert (tmp_path / "html" / page.with_suffix(".html").name).exists()
    world = (tmp_path / "html" / "api" / "world.html").read_text(encoding="utf-8")
    assert 'href="#shepherd_phys.scenario.Scenario"' in world  # names in backticks are links
    env = (tmp_path / "html" / "api" / "envs.html").read_text(encoding="utf-8")
    assert '<p class="rubric">Action space</p>' in env  # docstrings in Markdown are read as such
    assert '<th class="head"><p>channel</p></th>' in env


def test_every_picture_of_the_guide_is_there():
    pages = [*DOCS.glob("*.md"), *DOCS.glob("*/*.md"), ROOT / "README.md"]
    shown = [
        (page, target) for page in pages for target in re.findall(r"!\[[^]]*\]\(([^)]+)\)", page.read_text("utf-8"))
    ]
    assert shown
    assert not [(page.name, target) for page, target in shown if not (page.parent / target).is_file()]


@pytest.mark.slow
def test_first_steps_are_taken(tmp_path):
    """Every command of the page that is ours is run, with the preset that the page shows."""
    text = (DOCS / "first-steps.md").read_text(encoding="utf-8")
    (preset,) = re.findall(r"^```toml\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    (tmp_path / "quick.toml").write_text(preset, encoding="utf-8")
    commands = re.findall(r"^shepherd-phys (.*)$", text, re.MULTILINE)
    assert len(commands) == 4
    for command in commands:
        words = [str(Path(sys.executable).with_name("shepherd-phys")), *shlex.split(command)]
        done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, timeout=1800, check=False)
        assert done.returncode == 0, done.stderr
    for name in ("learning.png", "first.png", "results/first/summary.csv"):
        assert (tmp_path / name).exists()
