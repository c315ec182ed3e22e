"""What a user gets: the wheel, in an empty environment, away from the checkout."""

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PLACES = {
    "shepherd_phys": "shepherd_phys",
    **{name: f"shepherd_phys/{name}" for name in ("envs", "controllers", "scripts")},
}
MADE = ("build", "dist", "results", "runs", ".*", "*.egg-info", "__pycache__")

USE = """
import gymnasium
env = gymnasium.make("shepherd_phys.envs:Shepherding-v0")
env.reset(seed=0)
env.step(env.action_space.sample())
env.close()

import importlib.metadata
import sys
import shepherd_phys.controllers
assert shepherd_phys.__file__.startswith(sys.prefix), shepherd_phys.__file__
assert shepherd_phys.__version__ == importlib.metadata.version("shepherd-phys")
absent = {"torch", "stable_baselines3", "pygame", "matplotlib", "scipy", "polars", "pytest"}
assert not absent & set(importlib.metadata.packages_distributions()), "an extra came with the core"
print("used")
"""


def run(*command: str | Path, cwd: Path) -> str:
    """Standard output of a command that must succeed, in an environment without the caller's Python settings."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    done = subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel of a clean copy of the checkout, whose own build/ serves the editable install."""
    place = tmp_path_factory.mktemp("wheel")
    shutil.copytree(ROOT, place / "source", ignore=shutil.ignore_patterns(*MADE))
    run(sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", place, place / "source", cwd=place)
    (built,) = place.glob("*.whl")
    return built


def test_it_holds_one_package_and_all_of_it(wheel: Path) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    assert {name.split("/")[0] for name in names if ".dist-info/" not in name} == {"shepherd_phys"}
    assert not [name for name in names if "tests" in name.split("/") or name.split("/")[-1].startswith("test_")]
    assert {"shepherd_phys/py.typed", "shepherd_phys/learning/presets/fast.toml"} <= set(names)
    assert [name for name in names if name.endswith(".dist-info/licenses/LICENSE")]
    sources = {
        f"{inside}/{path.relative_to(ROOT / folder).as_posix()}"
        for folder, inside in PLACES.items()
        for path in (ROOT / folder).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert sources == {name for name in names if ".dist-info/" not in name}


@pytest.mark.slow
def test_it_works_with_its_core_dependencies_alone(wheel: Path, tmp_path: Path) -> None:
    run(sys.executable, "-m", "venv", "empty", cwd=tmp_path)
    python = tmp_path / "empty" / "bin" / "python"
    run(
        python, "-m", "pip", "install", "--quiet", "--no-compile", wheel, "-c", ROOT / "requirements.lock", cwd=tmp_path
    )
    run(python, "-m", "pip", "check", cwd=tmp_path)
    assert run(python, "-c", USE, cwd=tmp_path).split() == ["used"]
    assert (tmp_path / "empty" / "bin" / "shepherd-phys").exists()
