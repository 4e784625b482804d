"""Where a number comes from: the code, the packages, the machine and the command of an attempt.

Nothing here imports torch: whether a cell is stale must be known within a fraction of a second.
"""

from __future__ import annotations

import hashlib
import os
import platform
import re
import shlex
import subprocess
import sys
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import Any

from solar_cli.wording import without_password

PACKAGE = Path(__file__).parent.parent
DIFF_CHARACTERS = 100_000
"""Longest diff that is stored as text; its hash covers all of it."""


def code(package: Path = PACKAGE) -> dict[str, Any]:
    """The state of Solar's own source: ``version, commit, dirty, diff_sha256, diff``.

    ``commit`` is None where Solar does not run from a git checkout. Only the package's own folder
    counts for the diff, its new files included: cards are in a cell's hash already, and a report
    or a note written into the checkout changes no number.
    """
    release = _version("solar-cli") or "unknown"
    commit, diff = None, ""
    # An installed package may lie inside somebody else's repository: it must be tracked there.
    if _git(package, "ls-files", "--error-unmatch", "__init__.py") is not None:
        commit = (_git(package, "rev-parse", "HEAD") or "").strip() or None
        diff = (_git(package, "diff", "HEAD", "--no-ext-diff", "--", ".") or "") + "".join(
            f"new file {path}\n{_text(package / path)}\n" for path in _untracked(package)
        )
    return {
        "version": release,
        "commit": commit,
        "dirty": bool(diff),
        "diff_sha256": hashlib.sha256(diff.encode()).hexdigest() if diff else None,
        "diff": diff[:DIFF_CHARACTERS],
    }


def same_code(one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Whether two provenances name the same source, uncommitted changes included."""
    keys = ("commit", "diff_sha256") if one.get("commit") else ("commit", "version")
    return all(one.get(key) == other.get(key) for key in keys)


def code_name(record: Mapping[str, Any]) -> str:
    """What to call the code of a provenance: ``1a2b3c4``, ``1a2b3c4 with changes``, a version."""
    commit = record.get("commit")
    if not commit:
        return f"version {record.get('version', 'unknown')}"
    return f"{commit[:7]} with changes" if record.get("dirty") else str(commit[:7])


def provenance(device: str) -> dict[str, Any]:
    """All that is stored with an attempt, as plain JSON data."""
    return {
        **code(),
        "command": shlex.join(map(without_password, sys.argv)),
        "device": device,
        "python": platform.python_version(),
        "packages": package_versions(),
        "hardware": hardware(),
    }


def package_versions() -> dict[str, str]:
    """Versions of the packages that Solar uses at run time, where they are installed."""
    try:
        requirements = requires("solar-cli") or []
    except PackageNotFoundError:
        requirements = []
    used = [text for text in requirements if not re.search(r"extra == .dev.", text)]
    names = {re.split(r"[^A-Za-z0-9_.-]", text, maxsplit=1)[0] for text in used}
    found = {name: _version(name) for name in sorted(names - {"solar-cli"})}
    return {name: version for name, version in found.items() if version is not None}


def hardware() -> dict[str, Any]:
    """The machine: host, system, processor, cores that this process may use, memory, GPUs."""
    return {
        "host": platform.node(),
        "system": platform.platform(),
        "processor": _field("/proc/cpuinfo", "model name") or platform.machine(),
        "cores": cores(),
        "memory_bytes": memory_bytes("MemTotal"),
        "gpus": [
            _field(str(path), "Model") or "unknown"
            for path in sorted(Path("/proc/driver/nvidia/gpus").glob("*/information"))
        ],
    }


def cores() -> int:
    """Processor cores that this process may use."""
    return len(os.sched_getaffinity(0))


def memory_bytes(field: str) -> int | None:
    """A line of ``/proc/meminfo`` (``MemTotal``, ``MemAvailable``) in bytes; None without it."""
    text = _field("/proc/meminfo", field)
    return int(text.split()[0]) * 1024 if text else None


def _field(path: str, key: str) -> str | None:
    """The value of the first ``key : value`` line of a file of the kernel."""
    try:
        lines = Path(path).read_text(encoding="utf-8").splitlines()
    except OSError:
        return None
    for line in lines:
        label, _, value = line.partition(":")
        if label.strip() == key:
            return value.strip()
    return None


def _git(folder: Path, *arguments: str) -> str | None:
    """What git prints; None where it fails or is missing."""
    try:
        done = subprocess.run(
            ["git", "-C", str(folder), *arguments], capture_output=True, check=True, timeout=30
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.decode("utf-8", errors="backslashreplace")


def _untracked(folder: Path) -> list[str]:
    listing = _git(folder, "ls-files", "--others", "--exclude-standard", "-z", "--", ".")
    return [path for path in (listing or "").split("\0") if path]


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="backslashreplace")
    except OSError:  # removed since it was listed
        return ""


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None
