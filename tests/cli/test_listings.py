"""Listings and exports: what is printed, in which form, and that it is inert."""

import csv
import io
import json
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
from scenario import Done, Solar, Stored
from stored_cells import store_attempt

from solar_cli.settings import cells, load_card, registry
from solar_cli.store.owner import Owner
from solar_cli.store.records import Metric, Outcome
from solar_cli.store.store import Store

CONTROLS = ("\x1b", "\x07", "\r")


def inert(done: Done) -> None:
    """No stored text reaches the terminal as a command or as markup."""
    assert not any(control in done.out + done.err for control in CONTROLS)


def test_status_shows_the_state_of_every_cell(solar: Solar, stored: Stored) -> None:
    done = solar("status", "--db", stored.db)
    assert done.code == 0
    inert(done)
    lines = {line.split()[0]: line for line in done.out.splitlines() if line.strip()}
    for state in ("finished", "stale", "diverged", "failed", "interrupted", "pending"):
        assert state in lines[getattr(stored, state).hash[:8]]
    assert lines[stored.finished.hash[:8]].split()[-2:] == ["final_distance", "0.04"]
    assert "NaN in the ELBO" in lines[stored.diverged.hash[:8]]
    assert "[bold]not bold[/bold]" in done.out  # shown as it is, not as markup
    assert (
        "7 cells: 1 diverged, 1 failed, 2 finished, 1 interrupted, 1 pending, 1 stale" in done.out
    )


def test_status_says_why_a_cell_was_interrupted_and_what_a_running_one_does(
    solar: Solar, stored: Stored
) -> None:
    def note() -> str:
        entries = json.loads(solar("status", "--json", "--db", stored.db).out)
        [said] = [entry["note"] for entry in entries if entry["cell"] == stored.interrupted.hash]
        return str(said)

    assert "is gone" in note()  # its process could not say why
    with Store.open(str(stored.db)) as store:
        attempt = store_attempt(store, stored.interrupted, [], None, {})
        assert note() == "starting"
        store.beat(stored.interrupted.hash, attempt, "training", 0.5)
        assert note() == "training 50%"
        store.end(stored.interrupted.hash, attempt, Outcome.INTERRUPTED, "its files are lost")
    assert note() == "its files are lost"


def test_status_as_json_has_the_same_facts(solar: Solar, stored: Stored) -> None:
    entries = json.loads(solar("status", "--json", "--db", stored.db).out)
    assert len(entries) == 7
    first = next(entry for entry in entries if entry["cell"] == stored.finished.hash)
    assert (first["task"], first["method"], first["variant"]) == ("nav", "solar", "smoke")
    assert (first["state"], first["stale"], first["episodes"]) == ("finished", False, 16)
    assert first["value"] == pytest.approx(0.04)
    diverged = next(entry for entry in entries if entry["cell"] == stored.diverged.hash)
    assert diverged["value"] is None  # JSON has no nan


@pytest.mark.parametrize(
    ("options", "count"),
    [
        ((), 7),
        (("--task", "nav"), 7),
        (("--task", "nav-fixed"), 0),
        (("--method", "vae"), 2),
        (("--method", "vae", "--method", "solar"), 7),
        (("--variant", "smoke"), 6),
        (("--variant", "smoke", "--method", "solar"), 4),
    ],
)
def test_filters_narrow_a_listing(
    solar: Solar, stored: Stored, options: tuple[str, ...], count: int
) -> None:
    assert len(json.loads(solar("status", *options, "--json", "--db", stored.db).out)) == count


def test_a_listing_without_cells_says_how_to_start(solar: Solar, stored: Stored) -> None:
    done = solar("status", "--task", "nav-fixed", "--db", stored.db)
    assert (done.code, "solar run" in done.out) == (0, True)


def test_watching_ends_when_nothing_runs(solar: Solar, stored: Stored) -> None:
    assert solar("status", "--watch", "--db", stored.db).code == 0


def test_show_prints_curve_changes_attempts_and_log(solar: Solar, stored: Stored) -> None:
    done = solar("show", stored.finished.hash[:6], "--db", stored.db)
    assert done.code == 0
    inert(done)
    for part in (
        stored.finished.hash,
        "nav/solar:smoke seed 0",
        "finished: iteration 2, 16 episodes of 16",
        "final_distance in world units",
        "lower is better",
        "1 │",  # the curve's highest label
        "0.04 │",
        "methods.solar.training.steps",
        "variant smoke",
        "task.observation.height",
        "card",
        "Attempts",
        "last",
    ):
        assert part in done.out, part
    assert "task.step_seconds" not in done.out  # it is as the default
    assert done.out.count("first") == 14  # the log's end only


def test_show_as_json_holds_the_whole_configuration(solar: Solar, stored: Stored) -> None:
    entry = json.loads(solar("show", stored.finished.hash, "--json", "--db", stored.db).out)
    assert entry["configuration"] == json.loads(json.dumps(stored.finished.config()))
    assert entry["curve"] == [[0, 1.0], [8, 0.5], [16, 0.04]]
    assert [attempt["outcome"] for attempt in entry["attempts"]] == ["finished"]


@pytest.mark.parametrize("name", ["pending", "failed", "diverged", "interrupted"])
def test_show_works_for_a_cell_in_any_state(solar: Solar, stored: Stored, name: str) -> None:
    done = solar("show", getattr(stored, name).hash, "--db", stored.db)
    assert (done.code, done.err) == (0, "")
    inert(done)


def test_show_says_why_changes_of_a_card_that_is_gone_are_not_shown(
    solar: Solar, stored: Stored, tmp_path: Path
) -> None:
    from solar_cli.settings import cells, load_card

    card = tmp_path / "elsewhere.toml"
    card.write_text('extends = "nav"\n')
    [cell] = cells(load_card(str(card)), "solar", [0])
    with Store.open(str(stored.db)) as store:
        store.add([cell])
    done = solar("show", cell.hash, "--db", stored.db)
    assert (done.code, "not shown: unknown task 'elsewhere'" in done.err) == (0, True)
    assert "Different from" not in done.out


def test_show_says_what_needs_a_look(solar: Solar, stored: Stored) -> None:
    assert "needs a look" not in solar("show", stored.finished.hash, "--db", stored.db).out
    with Store.open(str(stored.db)) as store:
        attempt = store.claim(stored.pending.hash, Owner.current(), 8, {})
        signs = [Metric("stuck", 1.0), Metric("alive", 1.0)]
        totals = {"steps": 80, "simulated_seconds": 80.0, "seconds": 5.0}
        store.commit(stored.pending.hash, attempt, iteration=1, episodes=8, metrics=signs, **totals)
    [line] = [
        line
        for line in solar("show", stored.pending.hash, "--db", stored.db).out.splitlines()
        if line.startswith("needs a look: ")
    ]
    assert "episodes come to rest" in line
    entry = json.loads(solar("show", stored.pending.hash, "--json", "--db", stored.db).out)
    assert [f"needs a look: {sign}" for sign in entry["needs_a_look"]] == [line]


def test_export_has_one_row_a_metric_in_every_format(
    solar: Solar, stored: Stored, tmp_path: Path
) -> None:
    pandas = pytest.importorskip("pandas")
    text = solar("export", "--db", stored.db).out
    rows = list(csv.DictReader(io.StringIO(text)))
    assert list(rows[0]) == [
        *("cell", "task", "method", "variant", "seed", "iteration", "episodes", "steps"),
        *("split", "name", "value", "kind"),
    ]
    assert len(rows) == 3 * (3 + 3 + 3 + 2 + 2 + 1)
    assert {row["kind"] for row in rows} == {"finite", "nan", "-inf"}

    entries = json.loads(solar("export", "--format", "json", "--db", stored.db).out)
    assert len(entries) == len(rows)
    assert all((entry["value"] is None) == (entry["kind"] != "finite") for entry in entries)

    pytest.importorskip("pyarrow")
    path = tmp_path / "metrics.parquet"
    done = solar("export", "--format", "parquet", "--output", path, "--db", stored.db)
    assert (done.code, done.out) == (0, "")
    frame = pandas.read_parquet(path)
    assert len(frame) == len(rows)
    assert frame["value"].isna().sum() == 2  # the return and the distance of the diverged cell


def test_export_of_one_method_has_its_rows_only(solar: Solar, stored: Stored) -> None:
    text = solar("export", "--method", "vae", "--db", stored.db).out
    rows = list(csv.DictReader(io.StringIO(text)))
    assert {row["method"] for row in rows} == {"vae"}


def test_rm_asks_first_and_keeps_everything_without_a_yes(
    solar: Solar, stored: Stored, monkeypatch: pytest.MonkeyPatch
) -> None:
    for answer in ("n\n", "\n", ""):
        monkeypatch.setattr("sys.stdin", io.StringIO(answer))
        done = solar("rm", stored.finished.hash, "--db", stored.db)
        assert done.code == 1
        assert "nothing was done" in done.err
    assert len(json.loads(solar("status", "--json", "--db", stored.db).out)) == 7


def test_rm_removes_what_is_named_with_its_files(
    solar: Solar, stored: Stored, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = stored.db.parent / "cells" / stored.finished.hash
    assert folder.is_dir()
    monkeypatch.setattr("sys.stdin", io.StringIO("y\n"))
    assert solar("rm", stored.finished.hash[:8], "--db", stored.db).code == 0
    assert not folder.exists()
    done = solar("rm", "--method", "vae", "--yes", "--db", stored.db)
    assert (done.code, "removed 2" in done.out) == (0, True)
    left = {e["cell"] for e in json.loads(solar("status", "--json", "--db", stored.db).out)}
    assert left == {
        cell.hash for cell in (stored.second, stored.stale, stored.interrupted, stored.pending)
    }


def test_tasks_lists_the_cards_and_resolves_one(solar: Solar) -> None:
    names = [entry["task"] for entry in json.loads(solar("tasks", "--json").out)]
    assert {"nav", "nav-fixed"} <= set(names)
    command = ("tasks", "nav", "--variant", "smoke", "--set", "task.action.bound=2.0", "--json")
    lines = {line["path"]: line for line in json.loads(solar(*command).out)}
    origins = {
        "task.horizon": "variant smoke",
        "task.observation.height": "card",
        "task.action.bound": "--set",
        "task.step_seconds": "default",
        "methods.solar.training.steps": "variant smoke",
        "methods.solar.training.clip": "default",
    }
    assert {path: lines[path]["origin"] for path in origins} == origins
    assert lines["task.action.bound"]["value"] == 2.0
    assert lines["methods.solar.batches.initial"]["source"] == "App. D"
    assert all(line["description"] for line in lines.values())
    assert "methods.solar.training.steps" in solar("tasks", "nav").out
    assert "methods.vae.local_fit.method" in solar("tasks", "nav", "--method", "vae").out


def test_methods_lists_the_methods_and_the_settings_of_one(solar: Solar) -> None:
    entries = {entry["name"]: entry for entry in json.loads(solar("methods", "--json").out)}
    assert {"solar", "vae"} <= set(entries)
    lines = {line["path"]: line for line in json.loads(solar("methods", "solar", "--json").out)}
    assert lines["methods.solar.batches.initial"]["origin"] == "set by the card"
    assert lines["methods.solar.update.kl_step"]["origin"] == "default"
    assert "KL-constrained" in solar("methods").out


def test_a_method_that_cannot_be_loaded_hides_no_other(
    solar: Solar, monkeypatch: pytest.MonkeyPatch
) -> None:
    lost = EntryPoint("lost", "no_such_module:ENTRY", registry.GROUP)
    known = {**registry._known(), "lost": lost}
    monkeypatch.setattr(registry, "_known", lambda: known)
    done = solar("methods", "--json")
    assert done.code == 0
    assert set(known) - {entry["name"] for entry in json.loads(done.out)} == {"lost"}
    assert "method 'lost' of entry point 'no_such_module:ENTRY' cannot be loaded" in done.err
    assert not registry.is_level("lost")


def test_methods_says_where_one_departs_from_its_source_and_what_it_has_beyond(
    solar: Solar,
) -> None:
    entries = {entry["name"]: entry for entry in json.loads(solar("methods", "--json").out)}
    text = " ".join(solar("methods", "rce").out.split())
    assert entries["rce"]["deviations"] in text
    assert entries["rce"]["source"] in text
    assert "learns from: image, state; needs: costs" in text
    assert "restarts of poor representations (training.attempts = 3)" in text
    off = "off unless a card says so: judging by episodes without noise (batches.noise_free = 0)"
    assert off in text
    assert "going back to the best policy" in entries["rce"]["extras"]
    assert "judging by episodes without noise" not in entries["rce"]["extras"]
    assert entries["random"]["extras"] == []
    assert "extras on" not in solar("methods", "random").out


def test_tasks_resolves_a_card_for_its_first_method_where_solar_is_none(
    solar: Solar, tmp_path: Path
) -> None:
    card = tmp_path / "mine.toml"
    card.write_text(
        (Path(load_card("nav").path)).read_text().split("[methods.solar]")[0]
        + "[methods.ppo]\nhorizon = 20\nbudget = { desk = 10, full = 20 }\n"
    )
    lines = json.loads(solar("tasks", str(card), "--json").out)
    assert {line["path"].split(".")[1] for line in lines if "methods" in line["path"]} == {"ppo"}


def test_every_setting_of_a_card_can_be_set_by_the_path_that_tasks_prints(solar: Solar) -> None:
    """The first column of ``solar tasks NAME`` is what ``--set`` takes."""
    from solar_cli.cli.configuration import shown
    from solar_cli.settings import load_card, resolve

    lines = json.loads(solar("tasks", "nav", "--json").out)
    sets = [f"{line['path']}={shown(line['value'])}" for line in lines]
    card = load_card("nav")
    again = resolve(card, "solar", "default", sets)
    assert again.configuration == resolve(card, "solar").configuration


def test_compare_and_report_print_what_they_found(
    solar: Solar, stored: Stored, tmp_path: Path
) -> None:
    done = solar("compare", "vae:smoke", "solar:smoke", "--db", stored.db)
    assert done.code == 0, done
    assert "vae:smoke" in done.out
    for format, mark in (("markdown", "|---|"), ("latex", "tabular"), ("json", '"verdict"')):
        out = solar(
            "compare", "vae:smoke", "solar:smoke", "--format", format, "--db", stored.db
        ).out
        assert mark in out
    json.loads(solar("compare", "vae:smoke", "solar:smoke", "--json", "--db", stored.db).out)

    out = tmp_path / "out"
    done = solar("report", "--out", out, "--db", stored.db)
    assert done.code == 0, done
    assert "final_distance" in done.out
    assert f"page: {out / 'index.html'}" in done.out
    [curve] = out.rglob("curve.png")
    assert f"curve: {curve}" in done.out


def test_doctor_finds_this_machine_in_order(solar: Solar, stored: Stored, tmp_path: Path) -> None:
    checks = {check["name"]: check for check in json.loads(solar("doctor", "--json").out)}
    assert {"Python", "Solar", "packages", "torch", "database", "disk", "GL"} <= set(checks)
    done = solar("doctor", "--db", stored.db)
    assert done.code == 0, done
    assert "delete" in done.out  # the journal mode
    (tmp_path / "notes.txt").write_text("my notes\n" * 100)
    done = solar("doctor", "--db", tmp_path / "notes.txt")
    assert (done.code, "bad" in done.out) == (1, True)


@pytest.mark.parametrize("width", [70, 80, 100])
def test_a_narrow_status_keeps_a_line_a_cell_with_hash_and_state(
    solar: Solar, stored: Stored, monkeypatch: pytest.MonkeyPatch, width: int
) -> None:
    monkeypatch.setenv("COLUMNS", str(width))
    lines = solar("status", "--db", stored.db).out.splitlines()
    assert max(map(len, lines)) <= width
    for cell, state in ((stored.interrupted, "interrupted"), (stored.diverged, "diverged")):
        [line] = [line for line in lines if line.startswith(cell.hash[:8])]
        assert state in line.split()
        assert str(cell.seed) in line.split()
        assert cell.variant in line.split()
    assert lines[0].split()[-1] in ("value", "note")


@pytest.mark.parametrize("width", [80, 70])
def test_a_narrow_status_cuts_a_long_variant_and_keeps_it(
    solar: Solar, stored: Stored, monkeypatch: pytest.MonkeyPatch, width: int
) -> None:
    [cell] = cells(load_card("inverted-pendulum"), "solar", [0], "smoke", ["task.horizon=9"], "x1")
    long = cells(load_card("nav"), "solar", [0], "smoke", ["task.horizon=9"], "a-" + "long-" * 9)
    with Store.open(str(stored.db)) as store:
        store.add([cell, *long])
    monkeypatch.setenv("COLUMNS", str(width))
    lines = solar("status", "--db", stored.db).out.splitlines()
    assert max(map(len, lines)) <= width
    for one, shown in ((cell, "x1"), (long[0], "a-lo")):
        [line] = [line for line in lines if line.startswith(one.hash[:8])]
        assert line.split()[3].startswith(shown)


def test_a_bad_card_does_not_hide_the_others(solar: Solar, tmp_path: Path) -> None:
    (tmp_path / "tasks" / "folder.toml").mkdir(parents=True)
    (tmp_path / "tasks" / "broken.toml").write_text("[task\n")
    done = solar("tasks")
    assert done.code == 0
    assert "nav-fixed" in done.out
    assert "folder" not in done.out
    [line] = [line for line in done.out.splitlines() if line.startswith("broken")]
    assert "not valid TOML" in line
    entries = {entry["task"]: entry for entry in json.loads(solar("tasks", "--json").out)}
    assert "not valid TOML" in entries["broken"]["error"]
    assert "error" not in entries["nav"]


def test_a_card_that_hides_a_built_in_one_is_told_of(solar: Solar, tmp_path: Path) -> None:
    from solar_cli.settings import load_card

    original_path = load_card("nav").path
    (tmp_path / "tasks").mkdir()
    (tmp_path / "tasks" / "nav.toml").write_text(original_path.read_text())
    run = ("run", "--method", "solar", "--dry-run", "--task")
    for command in (("tasks",), ("tasks", "nav"), (*run, "nav")):
        done = solar(*command)
        assert (done.code, done.err.count("\n")) == (0, 1), done
        assert "tasks/nav.toml is used instead of the built-in card 'nav'" in done.err
    assert solar(*run, "nav-fixed").err == ""
    by_path = solar(*run, "tasks/nav.toml").err
    assert "tasks/nav.toml is used instead of the built-in card 'nav'" in by_path
    assert solar(*run, str(original_path)).err == ""


def test_a_card_that_misspells_a_method_is_told_of(solar: Solar, tmp_path: Path) -> None:
    (tmp_path / "tasks").mkdir()
    card = tmp_path / "tasks" / "mine.toml"
    card.write_text(
        'extends = "nav"\n[methods.sollar]\nbatches.initial = 3\n'
        "[variants.big.methods.vaee]\nbatches.initial = 3\n"
        "[methods.random-search]\nbudget = { desk = 1, full = 2 }\n"
    )
    for command in (("tasks", "mine"), ("run", "--method", "solar", "--dry-run", "--task", "mine")):
        done = solar(*command)
        assert (done.code, done.err.count("\n")) == (0, 2), done
        assert "tasks/mine.toml: 'methods.sollar'" in done.err
        assert "did you mean 'vae'?" in done.err


def test_a_misspelt_method_explains_the_settings_that_are_missing(
    solar: Solar, tmp_path: Path
) -> None:
    from solar_cli.settings import load_card

    card, original = tmp_path / "mine.toml", load_card("pusher").path.read_text()
    task_alone, _, _ = original.partition("[methods.")
    card.write_text(f"{task_alone}[methods.sollar]\nbudget = {{ desk = 1, full = 2 }}\n")
    for command in ("run", "diagnose"):
        done = solar(command, "--method", "solar", "--task", str(card))
        assert done.code == 2
        assert "'methods.sollar' has no effect" in done.err
        assert "did you mean 'solar'?" in done.err
        assert "'methods.solar.batches': Field required" in done.err


def test_show_says_where_the_time_went(solar: Solar, stored: Stored) -> None:
    with Store.open(str(stored.db)) as store:
        attempt = store.claim(stored.pending.hash, Owner.current(), 8, {})
        spent = [Metric("seconds_training", 3.0), Metric("seconds_evaluating", 1.0)]
        totals = {"steps": 80, "simulated_seconds": 80.0, "seconds": 5.0}
        store.commit(stored.pending.hash, attempt, iteration=1, episodes=8, metrics=spent, **totals)
    done = solar("show", stored.pending.hash, "--db", stored.db)
    rows = [line.split() for line in done.out.splitlines()]
    assert ["training", "networks", "3", "s", "60.0%"] in rows
    assert ["evaluating", "1", "s", "20.0%"] in rows
    entry = json.loads(solar("show", stored.pending.hash, "--json", "--db", stored.db).out)
    assert [share["share"] for share in entry["time"]] == [0.6, 0.2, 0.2]
    assert "Where the time went" not in solar("show", stored.second.hash, "--db", stored.db).out
