"""Migrations, classes and page agree; an interrupted migration leaves the old schema whole."""

import json
import os
import shutil
import signal
from collections.abc import Callable
from pathlib import Path

import pytest
from alembic.autogenerate import compare_metadata
from alembic.config import Config
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import Engine, Text, event, text
from test_store_concurrency import processes

from solar_cli.settings import Cell
from solar_cli.store import describe
from solar_cli.store.migrate import SCRIPTS
from solar_cli.store.records import State
from solar_cli.store.schema import PREFIX, VERSIONS, Base
from solar_cli.store.store import Store

ASSETS = Path(__file__).parent / "assets"
PAGE = Path(__file__).parent.parent.parent / "docs" / "schema.md"
MakeCells = Callable[..., list[Cell]]


def test_the_migrations_make_what_the_classes_say(store: Store) -> None:
    with store._database._engine.connect() as connection:
        assert compare_metadata(MigrationContext.configure(connection), Base.metadata) == []


def test_text_sorts_by_its_bytes_on_a_server_too(server: str) -> None:
    with Store.open(server) as store, store._database.reading() as session:
        collations = session.execute(
            text(
                "SELECT collation_name, count(*) FROM information_schema.columns "
                "WHERE table_schema = 'public' AND table_name <> 'alembic_version' "
                "AND data_type = 'text' GROUP BY collation_name"
            )
        ).all()
    columns = [c for t in Base.metadata.tables.values() for c in t.columns]
    assert collations == [("C", sum(isinstance(c.type, Text) for c in columns))]


def test_the_versions_that_opening_knows_are_those_of_the_migrations() -> None:
    config = Config()
    config.set_main_option("script_location", str(SCRIPTS))
    scripts = list(ScriptDirectory.from_config(config).walk_revisions())
    assert tuple(script.revision for script in reversed(scripts)) == VERSIONS
    assert all(version.startswith(PREFIX) for version in VERSIONS)


def test_the_page_of_the_schema_is_the_migrated_schema() -> None:
    assert PAGE.read_text() == describe.page()


def test_every_column_says_what_it_means() -> None:
    silent = [c.name for t in Base.metadata.tables.values() for c in t.columns if not c.doc]
    assert silent == []


def migrate_and_die(address: str, after: int) -> None:
    """Open a database, and be killed before its statement ``after`` + 1."""
    seen = 0

    @event.listens_for(Engine, "before_cursor_execute")
    def kill(_c: object, _k: object, statement: str, *_: object) -> None:
        nonlocal seen
        seen += statement.startswith(("CREATE", "INSERT", "COMMIT"))
        if seen > after:
            os.kill(os.getpid(), signal.SIGKILL)

    @event.listens_for(Engine, "commit")
    def kill_at_commit(_: object) -> None:
        os.kill(os.getpid(), signal.SIGKILL)

    Store.open(address)


def test_a_kill_anywhere_in_a_migration_leaves_the_old_schema(
    tmp_path: Path, make_cells: MakeCells
) -> None:
    statements = len(Base.metadata.tables) + 2  # and alembic_version with its row
    for after in range(statements + 1):
        path = tmp_path / f"{after}.db"
        process = processes.Process(target=migrate_and_die, args=(str(path), after))
        process.start()
        process.join()
        assert process.exitcode == -signal.SIGKILL
        with Store.open(str(path)) as store:
            assert store.cells() == []
            store.add(make_cells(0))
            assert len(store.cells()) == 1
            assert store.diagnose()["integrity"] == "ok"


@pytest.mark.parametrize("version", VERSIONS)
def test_a_database_of_every_past_schema_still_opens_with_all_it_holds(
    version: str, tmp_path: Path
) -> None:
    path = tmp_path / "solar.db"
    shutil.copy(ASSETS / f"{version}.db", path)
    expected = json.loads((ASSETS / f"{version}.json").read_text())
    with Store.open(str(path)) as store:
        (record,) = store.cells()
        cell = record.cell
        # Its settings have a value that today's do not know: cost fits by L-BFGS.
        assert cell.config()["method"]["cost_fit"]["optimiser"] == "lbfgs"
        assert record.hash == expected["hash"]
        assert record.state is State.FINISHED
        assert (record.iteration, record.episodes, record.commit) == (1, 40, "c0ffee")
        found = [
            [row["iteration"], row["split"], row["name"], row["kind"], row["episodes"]]
            for row in store.metrics()
        ]
        assert found == expected["metrics"]
        (values,) = [row["values"] for row in store.metrics(names=["final_distance"], values=True)]
        assert values.tolist() == [0.25, 0.5]
        assert [(c.iteration, c.path) for c in store.checkpoints(cell.hash)] == [
            (1, "checkpoints/1.0-1.pt")
        ]
        assert [artifact.kind for artifact in store.artifacts()] == ["animation"]
