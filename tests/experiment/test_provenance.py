"""Where a number comes from: two attempts ran the same code exactly when their records say so."""

import subprocess
import sys
from pathlib import Path

import pytest

from solar_cli.experiment.provenance import code, code_name, memory_bytes, provenance, same_code


def git(folder: Path, *arguments: str) -> None:
    identity = ["-c", "user.name=t", "-c", "user.email=t@example.org"]
    subprocess.run(["git", "-C", str(folder), *identity, *arguments], check=True)


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A package in a checkout of its own."""
    package = tmp_path / "package"
    package.mkdir()
    (package / "__init__.py").write_text("one = 1\n")
    (tmp_path / ".gitignore").write_text("*.log\n")
    git(tmp_path, "init", "--quiet")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "--quiet", "--message", "first")
    return package


def test_a_clean_checkout_is_its_commit(package: Path) -> None:
    record = code(package)
    assert len(record["commit"]) == 40
    assert (record["dirty"], record["diff_sha256"], record["diff"]) == (False, None, "")
    assert same_code(record, code(package))
    assert code_name(record) == record["commit"][:7]


def test_a_change_in_the_package_is_other_code_and_its_text_is_kept(package: Path) -> None:
    clean = code(package)
    (package / "__init__.py").write_text("one = 2\n")
    edited = code(package)
    assert edited["dirty"]
    assert "+one = 2" in edited["diff"]
    assert code_name(edited).endswith("with changes")
    (package / "__init__.py").write_text("one = 3\n")
    assert not same_code(clean, edited)
    assert not same_code(edited, code(package))
    (package / "__init__.py").write_text("one = 1\n")
    assert same_code(clean, code(package))


def test_a_new_file_in_the_package_is_other_code(package: Path) -> None:
    (package / "new.py").write_text("two = 2\n")
    first = code(package)
    assert "two = 2" in first["diff"]
    (package / "new.py").write_text("two = 3\n")
    assert not same_code(first, code(package))


def test_files_beside_the_package_and_ignored_ones_do_not_count(package: Path) -> None:
    clean = code(package)
    (package.parent / "report.html").write_text("a result")
    (package / "run.log").write_text("a log")
    assert code(package) == clean


def test_another_commit_is_other_code(package: Path) -> None:
    first = code(package)
    git(package, "commit", "--quiet", "--allow-empty", "--message", "second")
    assert not same_code(first, code(package))


def test_a_package_installed_within_a_foreign_checkout_has_no_commit(package: Path) -> None:
    installed = package.parent / ".venv" / "installed"
    installed.mkdir(parents=True)
    (installed / "__init__.py").touch()
    record = code(installed)
    assert record["commit"] is None
    assert code_name(record) == f"version {record['version']}"
    assert not same_code(record, record | {"version": "0"})


def test_a_password_in_the_command_is_not_stored(monkeypatch: pytest.MonkeyPatch) -> None:
    address = "postgresql://user:secret@host:5432/db"
    monkeypatch.setattr(sys, "argv", ["solar", "run", "--db", address])
    command = provenance("cpu")["command"]
    assert "secret" not in command
    assert "user:***@host:5432/db" in command
    monkeypatch.setattr(sys, "argv", ["solar", "run", f"--db={address}", "--label", "me@home"])
    assert provenance("cpu")["command"].endswith("user:***@host:5432/db' --label me@home")


def test_versions_are_known_without_importing_the_packages() -> None:
    program = (
        "import sys; from solar_cli.experiment.provenance import provenance\n"
        "versions = provenance('cpu')['packages']\n"
        "assert 'torch' in versions and 'numpy' in versions and 'pytest' not in versions\n"
        "assert 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", program], check=True)


def test_memory_is_read_in_bytes() -> None:
    kibibytes = next(
        int(line.split()[1])
        for line in Path("/proc/meminfo").read_text().splitlines()
        if line.startswith("MemTotal")
    )
    assert memory_bytes("MemTotal") == kibibytes * 1024
    assert memory_bytes("NoSuchLine") is None
