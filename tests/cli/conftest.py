"""Fixtures: the command ``solar``, and a database with a cell in every state."""

import shutil
from pathlib import Path

import pytest
from scenario import HOSTILE, Done, Solar, Stored, compute

from solar_cli.cli import main
from solar_cli.settings import cells, load_card
from solar_cli.store.records import Outcome
from solar_cli.store.store import Store

CODE = {"version": "1.0", "commit": "1" * 40, "dirty": False, "diff_sha256": None, "diff": ""}
"""The code that computed, and now looks: the real one may be edited while the tests run."""


@pytest.fixture
def solar(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> Solar:
    """The command ``solar`` in an empty folder, run by the code that the database knows."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("solar_cli.experiment.provenance.code", lambda: CODE)
    monkeypatch.setattr("solar_cli.experiment.matrix.code", lambda: CODE)
    monkeypatch.delenv("SOLAR_DB", raising=False)
    monkeypatch.delenv("SOLAR_HOME", raising=False)
    monkeypatch.delenv("COLUMNS", raising=False)

    def call(*arguments: object) -> Done:
        capsys.readouterr()
        exit_code = main([str(argument) for argument in arguments])
        return Done(exit_code, *capsys.readouterr())

    return call


@pytest.fixture(scope="session")
def template(tmp_path_factory: pytest.TempPathFactory) -> Stored:
    """Made once; tests get a copy each."""
    card, folder = load_card("nav"), tmp_path_factory.mktemp("template")
    finished, second, stale, interrupted = cells(card, "solar", range(4), "smoke")
    diverged, failed = cells(card, "vae", range(2), "smoke")
    pending = cells(card, "solar", [0])[0]
    stored = Stored(
        folder / "solar.db", finished, second, stale, diverged, failed, interrupted, pending
    )
    here, elsewhere = CODE, {**CODE, "commit": "0" * 40}
    with Store.open(str(stored.db)) as store:
        everything = [finished, second, stale, interrupted, diverged, failed, pending]
        store.add(everything)
        compute(store, finished, [1.0, 0.5, 0.04], Outcome.FINISHED, here)
        compute(store, second, [1.1, 0.6, 0.08], Outcome.FINISHED, here)
        compute(store, stale, [0.9, 0.4, 0.05], Outcome.FINISHED, elsewhere)
        compute(store, interrupted, [1.0, 0.7], Outcome.INTERRUPTED, here)
        compute(store, diverged, [1.0, float("nan")], Outcome.DIVERGED, here, "NaN in the ELBO")
        compute(store, failed, [1.0], Outcome.FAILED, here, HOSTILE)
        (store.folder(finished.hash)).mkdir(parents=True, exist_ok=True)
        (store.folder(finished.hash) / "log.txt").write_text("first\n" * 50 + "last \x1b[2J word\n")
    return stored


@pytest.fixture
def stored(template: Stored, tmp_path: Path) -> Stored:
    """A database of one's own."""
    home = tmp_path / "home"
    shutil.copytree(template.db.parent, home)
    return Stored(home / "solar.db", *(list(vars(template).values())[1:]))
