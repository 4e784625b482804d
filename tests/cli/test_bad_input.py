"""Every bad input gets one clear line, exit code 2 and no traceback, and loses nothing stored."""

import os
import sqlite3
from pathlib import Path

import pytest
from scenario import Done, Solar, Stored

RUN = ("run", "--task", "nav", "--method", "solar", "--variant", "smoke")

FAULTS = {
    "unknown task": (("--task", "nva"), ["'nva'", "did you mean 'nav'"]),
    "task with a name that no file can have": (("--task", "n" * 300), ["'nnn", "known: "]),
    "card with a name that no file can have": (
        ("--task", "n" * 300 + ".toml"),
        ["nnn.toml", "cannot be read"],
    ),
    "unknown method": (("--method", "sloar"), ["'sloar'", "did you mean 'solar'"]),
    "unknown variant": (("--variant", "smok"), ["'smok'", "did you mean 'smoke'"]),
    "unknown setting": (("--set", "task.horzon=3"), ["task.horzon", "did you mean 'horizon'"]),
    "ill-typed setting": (("--set", 'task.horizon="x"'), ["task.horizon", "integer", "'x'"]),
    "unknown parameter of the simulator": (
        ("--set", "task.parameters.gaol=[0.0, 0.0]"),
        ["'gaol'", "did you mean 'goal'"],
    ),
    "unknown simulator": (("--set", 'task.simulator="nav"'), ["'nav'", "navigation"]),
    "no TOML": (("--set", "task.horizon=ten"), ["'ten'", "quotes"]),
    "no assignment": (("--set", "task.horizon"), ["PATH=VALUE"]),
    "setting given twice": (
        ("--set", "task.horizon=12", "--set", "task . horizon = 13"),
        ["task.horizon is set twice"],
    ),
    "setting given in a table, too": (
        ("--set", "task.exploration={ std = 2.0 }", "--set", "task.exploration.std=3.0"),
        ["task.exploration.std is set twice"],
    ),
    "setting of a method that does not run": (
        ("--set", "methods.vae.training.steps=3"),
        ["methods.vae.training.steps=3", "no method 'vae'"],
    ),
    "seeds that are none": (("--seeds", "many"), ["--seeds 'many'", "3,5,8"]),
    "no seeds": (("--seeds", "0"), ["--seeds '0'"]),
    "budget of zero": (("--budget", "0"), ["--budget '0'", "desk, full or a number"]),
    "budget that is none": (("--budget", "lots"), ["--budget 'lots'"]),
    "budget beyond counting": (("--budget", "9" * 23), ["--budget '999", "1000000000"]),
    "budget beyond reading": (("--budget", "9" * 5000), ["--budget '999", "1000000000"]),
    "budget of a setting beyond counting": (
        ("--set", f"methods.solar.budget.desk={10**19}"),
        ["'methods.solar.budget.desk'", "1000000000"],
    ),
    "label that is no name": (("--set", "task.horizon=9", "--label", "A B"), ["--label 'A B'"]),
    "no workers": (("--workers", "0"), ["--workers", "1"]),
    "unknown device": (("--device", "tpu"), ["--device", "tpu", "cpu"]),
    "unknown option": (("--sedes", "3"), ["--sedes"]),
    "missing card": (("--task", "absent/card.toml"), ["absent/card.toml", "cannot be read"]),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_run_refuses_bad_input(solar: Solar, stored: Stored, fault: str) -> None:
    extra, parts = FAULTS[fault]
    before = stored.db.read_bytes()
    solar(*RUN, *extra, "--db", stored.db).refused(*parts)
    assert stored.db.read_bytes() == before


@pytest.mark.parametrize(
    "arguments",
    [("run",), ("run", "--task", "nav"), ("show",), ("taks",), ("status", "--wtach")],
)
def test_a_command_line_that_cannot_be_parsed_is_one_line(
    solar: Solar, arguments: tuple[str, ...]
) -> None:
    solar(*arguments).refused("solar: ")


def test_a_malformed_card_names_file_and_place(solar: Solar, tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text('summary = "x"\n[task\n')
    solar("run", "--task", "mine.toml", "--method", "solar").refused("mine.toml", "line 2")
    (tmp_path / "mine.toml").write_text('summary = "x"\n[task]\nhorizon = 3\n')
    solar("tasks", "mine.toml").refused("mine.toml", "'task.simulator'", "required")


LISTINGS = (("status",), ("export",), ("rm",))


@pytest.mark.parametrize("listing", LISTINGS)
@pytest.mark.parametrize("option", ["--task", "--method", "--variant"])
def test_a_listing_refuses_a_name_that_nothing_has(
    solar: Solar, stored: Stored, listing: tuple[str, ...], option: str
) -> None:
    solar(*listing, option, "smoky", "--db", stored.db).refused(option, "'smoky'")


COMMANDS = (
    ("status",),
    ("show", "ab"),
    ("report",),
    ("compare",),
    ("export",),
    ("rm", "ab"),
    (*RUN, "--dry-run"),
    RUN,
)


def every_command(solar: Solar, db: object) -> list[Done]:
    return [solar(*command, "--db", db) for command in COMMANDS]


def test_a_file_that_is_no_database_is_refused_and_left_alone(solar: Solar, tmp_path: Path) -> None:
    path = tmp_path / "notes.txt"
    path.write_text("my notes\n" * 100)
    for done in every_command(solar, path):
        done.refused("notes.txt", "not a Solar database")
    assert path.read_text() == "my notes\n" * 100


def test_somebody_elses_database_is_refused_and_left_alone(solar: Solar, tmp_path: Path) -> None:
    path = tmp_path / "other.db"
    with sqlite3.connect(path) as other:
        other.execute("create table songs (title text)")
    before = path.read_bytes()
    for done in every_command(solar, path):
        done.refused("other.db", "not a Solar database")
    assert path.read_bytes() == before


def test_a_database_of_a_newer_program_is_refused_and_left_alone(
    solar: Solar, stored: Stored
) -> None:
    with sqlite3.connect(stored.db) as newer:
        revision = newer.execute("select version_num from alembic_version").fetchone()[0]
        prefix = revision.rstrip("0123456789")
        newer.execute("update alembic_version set version_num = ?", [f"{prefix}9999"])
    before = stored.db.read_bytes()
    for done in every_command(solar, stored.db):
        done.refused("newer than this program", "upgrade")
    assert stored.db.read_bytes() == before


@pytest.mark.parametrize(
    ("address", "parts"),
    [
        ("mysql://host/solar", ["mysql", "postgresql"]),
        ("sqlite://", ["sqlite"]),
        ("postgresql://127.0.0.1:1/solar", ["127.0.0.1", "--db"]),
    ],
)
def test_an_address_that_leads_nowhere_is_refused(
    solar: Solar, address: str, parts: list[str]
) -> None:
    solar("status", "--db", address).refused(*parts)


def test_a_password_is_never_printed(solar: Solar) -> None:
    for command in COMMANDS:
        done = solar(*command, "--db", "postgresql://me:hunter2@127.0.0.1:1/solar")
        done.refused("127.0.0.1")
        assert "hunter2" not in done.out + done.err
    for address in (
        "mysql://me:hunter2@127.0.0.1/solar",
        "postgresql://me:hunter2@127.0.0.1:1",
        "postgresql://me:hunter2@127.0.0.1:port/solar",
        "postgresql://127.0.0.1:1/solar?user=me&password=hunter2",
    ):
        done = solar("status", "--db", address)
        done.refused("--db" if "?" in address else "address")
        assert "hunter2" not in done.err


def test_a_folder_that_cannot_be_written_is_refused(solar: Solar, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    solar(*RUN, "--db", tmp_path / "file" / "solar.db").refused("file", "--db")
    if os.geteuid() != 0:  # nothing is unwritable for root
        (tmp_path / "locked").mkdir(mode=0o500)
        solar(*RUN, "--db", tmp_path / "locked" / "solar.db").refused("locked", "--db")


def test_a_missing_gpu_is_refused_before_anything_is_scheduled(
    solar: Solar, stored: Stored, monkeypatch: pytest.MonkeyPatch
) -> None:
    import torch

    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    arguments = (*RUN, "--seeds", "7:8", "--device", "cuda", "--db", stored.db)
    before = stored.db.read_bytes()
    solar(*arguments).refused("--device cuda", "GPU", "--device cpu")
    assert stored.db.read_bytes() == before


def test_an_unknown_cell_is_refused(solar: Solar, stored: Stored) -> None:
    for command in ("show", "rm"):
        solar(command, "zzzz", "--db", stored.db).refused("'zzzz'")
    solar("show", "", "--db", stored.db).refused("give more digits")
    solar("rm", "--db", stored.db).refused("--task")
    solar("rm", "ab", "--task", "nav", "--db", stored.db).refused("--task")


def test_an_export_overwrites_nothing_unasked(solar: Solar, stored: Stored, tmp_path: Path) -> None:
    kept = tmp_path / "kept.csv"
    kept.write_text("precious")
    solar("export", "--output", kept, "--db", stored.db).refused("kept.csv", "--force")
    assert kept.read_text() == "precious"
    assert solar("export", "--output", kept, "--force", "--db", stored.db).code == 0
    assert kept.read_text().startswith("cell,")
    solar("export", "--output", tmp_path / "no" / "x.csv", "--db", stored.db).refused("x.csv")


def test_a_missing_database_is_said_and_none_is_made(solar: Solar, tmp_path: Path) -> None:
    commands = (("status",), ("export",), ("report",), ("compare",), ("show", "ab"), ("rm", "ab"))
    for command in (*commands, ("rm", "--task", "nav", "--yes")):
        solar(*command, "--db", tmp_path / "absent.db").refused("absent.db", "solar run")
    assert list(tmp_path.iterdir()) == []
