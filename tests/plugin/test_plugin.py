"""A method of another package: installed, run, stored and reported like one of our own."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent / "solar_random_search"
README = Path(__file__).parent.parent.parent / "README.md"


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that the example package is installed into, as pip does it."""
    target = tmp_path_factory.mktemp("installed")
    source = tmp_path_factory.mktemp("source")
    for file in PACKAGE.iterdir():  # a build must not write into the tree
        if file.is_file():
            (source / file.name).write_bytes(file.read_bytes())
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    options = ["--no-deps", "--no-build-isolation", "--no-index", "--target", str(target)]
    subprocess.run([*command, *options, str(source)], check=True)
    return target


def solar(installed: Path, folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """The command in a fresh process that sees the installed package."""
    program = "import sys; from solar_cli.cli import main; sys.exit(main())"
    return subprocess.run(
        [sys.executable, "-c", program, *arguments, "--db", str(folder / "solar.db")],
        capture_output=True,
        text=True,
        check=False,
        cwd=folder,
        # A parallel test runner sets COLUMNS, and tables would be cut.
        env={k: v for k, v in os.environ.items() if k != "COLUMNS"}
        | {"PYTHONPATH": str(installed)},
    )


def test_an_installed_method_is_listed_with_its_settings(installed: Path, tmp_path: Path) -> None:
    listed = json.loads(solar(installed, tmp_path, "methods", "--json").stdout)
    assert "random-search" in [entry["name"] for entry in listed]
    settings = solar(installed, tmp_path, "methods", "random-search").stdout
    assert "methods.random-search.population" in settings


RUN = ("run", "--task", "nav", "--method", "random-search", "--variant", "smoke")


@pytest.fixture(scope="module")
def computed(installed: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a database that has a finished cell of the installed method."""
    folder = tmp_path_factory.mktemp("computed")
    done = solar(installed, folder, *RUN, "--seeds", "1", "--budget", "950")
    assert done.returncode == 0, done
    return folder


def test_an_installed_method_learns_continues_and_is_exported(
    installed: Path, computed: Path
) -> None:
    again = solar(installed, computed, *RUN, "--seeds", "1", "--budget", "1000")
    assert "has 950 of 1000 episodes" in again.stdout
    assert again.returncode == 0, again
    exported = solar(installed, computed, "export", "--format", "json").stdout
    distance = {
        row["episodes"]: row["value"]
        for row in json.loads(exported)
        if (row["name"], row["split"]) == ("final_distance", "noise_free")
    }
    assert list(distance) == list(range(0, 1001, 50))
    assert distance[1000] < 0.75 * distance[0]  # it learns, from costs alone


def test_what_an_uninstalled_method_left_can_still_be_listed(
    computed: Path, tmp_path: Path
) -> None:
    listed = solar(tmp_path, computed, "status")  # nothing is installed in this folder
    assert (listed.returncode, listed.stderr) == (0, "")
    assert "random-search" in listed.stdout


def test_the_readme_shows_the_very_file() -> None:
    blocks = re.findall(r"^```python\n(.*?)^```$", README.read_text(), re.MULTILINE | re.DOTALL)
    assert (PACKAGE / "solar_random_search.py").read_text() in blocks


def test_the_readme_shows_the_very_entry_point() -> None:
    blocks = re.findall(r"^```toml\n(.*?)^```$", README.read_text(), re.MULTILINE | re.DOTALL)
    [entry] = [block for block in blocks if "entry-points" in block]
    assert entry in (PACKAGE / "pyproject.toml").read_text()
