"""Whether this machine has what a run needs: each check says what it found, and what to do."""

from __future__ import annotations

import os
import platform
import shutil
import sqlite3
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from importlib.metadata import version
from pathlib import Path

from solar_cli.errors import SolarError, UsageError
from solar_cli.experiment.provenance import cores, package_versions
from solar_cli.store.address import locate
from solar_cli.store.database import file_system
from solar_cli.store.store import Store

LEAST_FREE = 2 * 2**30
"""Bytes of free disk from which there is a warning: some ten cells at their largest."""
NETWORK = ("nfs", "cifs", "smb", "9p", "lustre", "beegfs", "gpfs", "ceph", "fuse.sshfs")
"""File systems on which locks, and so SQLite, may fail."""


class Verdict(StrEnum):
    """Whether something is as it should be."""

    GOOD = "ok"
    DOUBTFUL = "warning"
    BAD = "bad"


@dataclass(frozen=True)
class Check:
    """One thing that was looked at."""

    name: str
    found: str
    verdict: Verdict = Verdict.GOOD
    advice: str = ""


def checks(address: str | None) -> Iterator[Check]:
    """All checks, for the database at ``address``."""
    yield Check("Python", f"{platform.python_version()} on {platform.platform()}")
    yield from packages()
    yield torch_build()
    yield from store(address)
    yield gl()


def packages() -> Iterator[Check]:
    """Versions of Solar and of what it stands on."""
    yield Check("Solar", version("solar-cli"))
    found = package_versions()
    yield Check("packages", ", ".join(f"{name} {number}" for name, number in found.items()))


def torch_build() -> Check:
    """The devices that torch sees, and its threads."""
    try:
        import torch
    except Exception as error:  # a broken build fails in many ways, and none may hide the rest
        return Check("torch", str(error), Verdict.BAD, "reinstall torch")
    threads = f"{torch.get_num_threads()} threads, {cores()} cores"
    if not torch.cuda.is_available():
        return Check("torch", f"{torch.__version__}, {threads}, no CUDA device")
    names = [torch.cuda.get_device_name(index) for index in range(torch.cuda.device_count())]
    return Check("torch", f"{torch.__version__}, {threads}, CUDA: {', '.join(names)}")


def store(address: str | None) -> Iterator[Check]:
    """The database, and the folder of the cells' files."""
    try:
        location = locate(address)
        if location.is_new:
            yield Check("database", f"{location}: none yet, the first run makes it")
            yield Check("SQLite", sqlite3.sqlite_version)
        else:
            if isinstance(location.place, Path) and not os.access(location.place, os.W_OK):
                advice = "change its rights, or choose another with --db"
                yield Check("database", f"{location}: read-only", Verdict.BAD, advice)
            with Store.open(address, read_only=True) as opened:
                yield from (judged(name, said) for name, said in opened.diagnose().items())
    except SolarError as error:
        yield Check("database", str(error), Verdict.BAD, "choose another with --db or SOLAR_DB")
        return
    yield from folder(location.home)


def judged(name: str, found: str) -> Check:
    """What the database says of itself, with a verdict."""
    if name in ("integrity", "references") and found != "ok":
        return Check(name, found, Verdict.BAD, "copy the file away, then restore a backup")
    if name == "journal" and found != "delete":
        return Check(name, found, Verdict.DOUBTFUL, "another program changed it; end that one")
    return Check(name, found)


def folder(home: Path) -> Iterator[Check]:
    """Permission, file system and space where ``home`` is, or will be."""
    there = next(path for path in (home, *home.absolute().parents) if path.is_dir())
    try:
        with tempfile.TemporaryFile(dir=there):
            yield Check("folder", f"{home.absolute()}, writable")
    except OSError as error:
        advice = "change its rights, or choose another with --db"
        yield Check("folder", f"{there}: {error.strerror}", Verdict.BAD, advice)
    kind = file_system(there.resolve())
    if kind.startswith(NETWORK):
        advice = "locks may fail there: keep the database on a local disk, or use PostgreSQL"
        yield Check("file system", kind, Verdict.DOUBTFUL, advice)
    else:
        yield Check("file system", kind)
    free = shutil.disk_usage(there).free
    found = f"{free / 2**30:.1f} GiB free"
    if free < LEAST_FREE:
        yield Check("disk", found, Verdict.DOUBTFUL, "remove cells with solar rm")
    else:
        yield Check("disk", found)


def gl() -> Check:
    """Whether MuJoCo draws; only tasks in pixels of MuJoCo need it to."""
    from solar_cli.envs.offscreen import load_mujoco, make_renderer

    try:
        mujoco = load_mujoco()
        make_renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 8, 8).render()
    except UsageError as error:
        return Check("GL", str(error), Verdict.DOUBTFUL, "only tasks of MuJoCo need this")
    return Check("GL", f"MuJoCo draws, MUJOCO_GL is {os.environ.get('MUJOCO_GL') or 'not set'}")
