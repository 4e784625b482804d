"""Writing a report into a folder that may hold other people's files.

The folder has a list of what Solar wrote there. Only files on it are ever replaced or removed.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path, PurePosixPath

from solar_cli.errors import SolarError, UsageError

LIST = ".solar-report.json"


def publish(out: Path, files: Mapping[str, bytes]) -> list[Path]:
    """Write ``files`` (path below ``out`` -> content), and remove what an earlier report left.

    Every file appears whole or not at all, and the list always names at least what is there.
    Raises `UsageError` for a folder that cannot be written, and for one where another program's
    file stands in the way: nothing is touched then.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        ours = _listed(out)
        targets = {name: _inside(out, name) for name in files}
        for name, path in targets.items():
            if os.path.lexists(path) and name not in ours:
                raise UsageError(
                    f"--out {out}: {name} is there and was not written by `solar report`: "
                    "move it, or choose another folder"
                )
        _write(out / LIST, _list({*ours, *files}))
        for name, content in files.items():
            targets[name].parent.mkdir(parents=True, exist_ok=True)
            _write(targets[name], content)
        for name in ours - set(files):
            _remove(out, name)
        _write(out / LIST, _list(files))
    except OSError as error:
        raise UsageError(
            f"--out {out}: cannot be written ({error.strerror or error}): choose another folder"
        ) from error
    return list(targets.values())


def _listed(out: Path) -> set[str]:
    """What earlier reports wrote; names that would lead out of the folder are not ours."""
    try:
        names = json.loads((out / LIST).read_text(encoding="utf-8"))
    except FileNotFoundError:
        return set()
    except (ValueError, UnicodeDecodeError):
        names = None
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise SolarError(
            f"--out {out}: {LIST} does not list files: remove it together with the old report"
        )
    return {name for name in names if _is_below(name)}


def _list(names: Mapping[str, bytes] | set[str]) -> bytes:
    return (json.dumps(sorted(names), indent=0) + "\n").encode()


def _is_below(name: str) -> bool:
    path = PurePosixPath(name)
    return not path.is_absolute() and ".." not in path.parts and path.parts not in ((), (LIST,))


def _inside(out: Path, name: str) -> Path:
    """The path of ``name``. Raises `UsageError` where a link leads it out of the folder."""
    path = out / name
    if not path.parent.resolve().is_relative_to(out.resolve()):
        raise UsageError(f"--out {out}: {name} leads out of the folder: remove that link")
    return path


def _write(path: Path, content: bytes) -> None:
    beside = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        beside.write_bytes(content)
        beside.replace(path)
    finally:
        beside.unlink(missing_ok=True)


def _remove(out: Path, name: str) -> None:
    """Remove a file of an earlier report, and the folders that it leaves empty."""
    path = _inside(out, name)
    path.unlink(missing_ok=True)
    for folder in path.parents:
        if folder == out or not folder.is_dir() or any(folder.iterdir()):
            break
        folder.rmdir()
