"""What the store promises, on every kind of database."""

import math
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from itertools import pairwise

import numpy as np
import pytest
from sqlalchemy import event, text

from solar_cli.errors import SolarError, UsageError
from solar_cli.settings import Cell
from solar_cli.store.owner import Owner
from solar_cli.store.records import (
    CellBusy,
    CheckpointRecord,
    Fenced,
    Metric,
    Outcome,
    State,
)
from solar_cli.store.store import Store

Claimed = tuple[Store, str, int]
MakeCells = Callable[..., list[Cell]]
Commit = Callable[..., None]
ELSEWHERE = Owner("elsewhere", 1, 1.0, "another boot")


def checkpoint(iteration: int, position: int = 0, complete: bool = True) -> CheckpointRecord:
    return CheckpointRecord(
        path=f"checkpoints/{iteration}.{position}.pt",
        sha256="0" * 64,
        bytes=7,
        iteration=iteration,
        episodes=10 * iteration,
        position=position,
        complete=complete,
    )


def count(store: Store, table: str) -> int:
    with store._database.reading() as session:
        return int(session.execute(text(f"SELECT count(*) FROM {table}")).scalar_one())


# Cells


def test_a_cell_comes_back_as_it_was_added(store: Store, make_cells: MakeCells) -> None:
    (cell,) = make_cells(3, method="vae", variant="smoke")
    before = datetime.now(UTC)
    store.add([cell])
    (record,) = store.cells()
    assert record.cell.configuration == cell.configuration
    assert (record.cell.title, record.hash) == (cell.title, cell.hash)
    assert record.state is State.PENDING
    assert (record.iteration, record.episodes, record.steps, record.seconds) == (0, 0, 0, 0.0)
    assert (record.target, record.last_attempt, record.commit) == (None, None, None)
    assert abs(record.created - before) < timedelta(seconds=30)


def test_adding_again_changes_nothing(claimed: Claimed, make_cells: MakeCells) -> None:
    store, hash, _ = claimed
    (before,) = store.cells()
    store.add([*make_cells(0), *make_cells(0, 1)])
    assert [record.cell.seed for record in store.cells()] == [0, 1]
    assert store.cells(hashes=[hash])[0].created == before.created
    assert store.cells(hashes=[hash])[0].state is State.RUNNING


def test_cells_are_sorted_and_selected_by_every_name(store: Store, make_cells: MakeCells) -> None:
    store.add(make_cells(10, 9, method="vae"))
    store.add(make_cells(2, variant="smoke") + make_cells(2, 1))
    names = [(r.cell.method, r.cell.variant, r.cell.seed) for r in store.cells()]
    default, smoke = "default", "smoke"
    assert names == [
        ("solar", default, 1),
        ("solar", default, 2),
        ("solar", smoke, 2),
        ("vae", default, 9),
        ("vae", default, 10),
    ]
    hash = store.cells(seeds=[9])[0].hash
    assert len(store.cells(tasks=["nav"])) == 5
    assert store.cells(tasks=["car"]) == []
    assert len(store.cells(methods=["solar"], seeds=[2, 9])) == 2
    assert len(store.cells(variants=["smoke"])) == 1
    assert [r.cell.seed for r in store.cells(hashes=[hash])] == [9]


def test_a_cell_is_found_by_an_unambiguous_prefix(store: Store, make_cells: MakeCells) -> None:
    store.add(make_cells(*range(20)))  # more cells than first digits: two share one
    hashes = sorted(record.hash for record in store.cells())
    shared = next(a[0] for a, b in pairwise(hashes) if a[0] == b[0])
    assert store.find(hashes[4]).hash == hashes[4]
    assert store.find(hashes[4][:12].upper()).hash == hashes[4]
    with pytest.raises(UsageError, match="give more digits"):
        store.find(shared)
    for none in ("zz", "%", "_"):
        with pytest.raises(UsageError, match="no cell"):
            store.find(none)
    with pytest.raises(UsageError, match=f"did you mean '{hashes[4]}'"):
        store.find(hashes[4][:-1] + "x")


def test_remove_deletes_every_row_and_file_of_a_cell_and_no_other(
    claimed: Claimed, make_cells: MakeCells, me: Owner, commit: Commit
) -> None:
    store, hash, attempt = claimed
    (other,) = make_cells(1)
    store.add([other])
    commit(
        store, other.hash, store.claim(other.hash, me, 9, {}), 0, metrics=[Metric("return", 1.0)]
    )
    commit(store, hash, attempt, 1, metrics=[Metric("return", 1.0)], checkpoint=checkpoint(1))
    for folder in (store.folder(hash), store.folder(other.hash)):
        folder.mkdir(parents=True)
        (folder / "animation.npz").write_bytes(b"frames")
    store.add_artifact(hash, attempt, "animation", store.folder(hash) / "animation.npz", 1)
    store.end(hash, attempt, Outcome.FINISHED)

    store.remove([hash])

    assert [record.hash for record in store.cells()] == [other.hash]
    assert not store.folder(hash).exists()
    assert (store.folder(other.hash) / "animation.npz").exists()
    rows = {t: count(store, t) for t in ("attempt", "metric", "checkpoint", "artifact")}
    assert rows == {"attempt": 1, "metric": 1, "checkpoint": 0, "artifact": 0}


def test_remove_refuses_a_running_cell_and_then_removes_none(
    claimed: Claimed, make_cells: MakeCells
) -> None:
    store, *_ = claimed
    store.add(make_cells(1))
    with pytest.raises(SolarError, match="is running"):
        store.remove([record.hash for record in store.cells()])
    assert len(store.cells()) == 2
    with pytest.raises(UsageError, match="no cell"):
        store.remove(["0123"])


# Attempts


def test_the_state_of_a_cell_follows_its_newest_attempt(claimed: Claimed, me: Owner) -> None:
    store, hash, attempt = claimed
    for outcome in Outcome:
        assert store.find(hash).state is State.RUNNING
        store.end(hash, attempt, outcome, error="why")
        assert store.find(hash).state == State(outcome.value)
        attempt = store.claim(hash, me, 200, {})
    attempts = store.attempts(hash)
    assert [a.number for a in attempts] == [1, 2, 3, 4, 5]
    assert [a.outcome for a in attempts] == [*Outcome, None]
    assert attempts[0].error == "why"


def test_an_attempt_comes_back_as_it_was_made(claimed: Claimed, me: Owner) -> None:
    store, hash, attempt = claimed
    store.beat(hash, attempt, "training the model", 0.25)
    record = store.find(hash)
    last = record.last_attempt
    assert last is not None
    assert (last.owner, last.number, last.target, record.target) == (me, 1, 100, 100)
    assert (last.activity, last.fraction) == ("training the model", 0.25)
    assert last.provenance == {"commit": "c0ffee", "dirty": True}
    assert (record.commit, record.dirty) == ("c0ffee", True)
    assert last.started <= last.heartbeat
    assert last.started.tzinfo is UTC
    assert last.ended is None
    assert store.attempts(hash) == [last]


def test_a_live_owner_keeps_its_cell(claimed: Claimed, me: Owner) -> None:
    store, hash, _ = claimed
    with pytest.raises(CellBusy, match=f"process {me.pid} on {me.host}"):
        store.claim(hash, ELSEWHERE, 100, {})


def heard(store: Store, seconds_ago: float) -> None:
    """Set back the clock of all heartbeats."""
    with store._database.writing() as session:
        then = store._database.now(session) - timedelta(seconds=seconds_ago)
        session.execute(text("UPDATE attempt SET heartbeat = :then"), {"then": stored(store, then)})


def stored(store: Store, moment: datetime) -> object:
    return moment.replace(tzinfo=None).isoformat(" ") if store._database.sqlite else moment


def test_an_owner_that_cannot_be_seen_keeps_its_cell_for_the_lease(
    store: Store, make_cells: MakeCells, me: Owner
) -> None:
    (cell,) = make_cells(0)
    store.add([cell])
    store.claim(cell.hash, ELSEWHERE, 100, {})
    heard(store, 50)  # the lease is 60 s; the test itself takes well under 10
    assert store.find(cell.hash).state is State.RUNNING
    with pytest.raises(CellBusy):
        store.claim(cell.hash, me, 100, {})
    heard(store, 61)
    assert store.find(cell.hash).state is State.INTERRUPTED
    assert store.claim(cell.hash, me, 100, {}) == 2
    first = store.attempts(cell.hash)[0]
    assert first.outcome is Outcome.INTERRUPTED
    assert first.ended == first.heartbeat
    assert first.error is not None
    assert "elsewhere" in first.error


def test_every_sign_of_life_renews_the_lease(
    store: Store, make_cells: MakeCells, commit: Commit
) -> None:
    (cell,) = make_cells(0)
    store.add([cell])
    attempt = store.claim(cell.hash, ELSEWHERE, 100, {})
    signs: list[Callable[[], None]] = [
        lambda: store.beat(cell.hash, attempt, "working", 0.5),
        lambda: commit(store, cell.hash, attempt, 1),
    ]
    for sign in signs:
        heard(store, 61)
        assert store.find(cell.hash).state is State.INTERRUPTED
        sign()
        assert store.find(cell.hash).state is State.RUNNING


def test_every_write_of_a_late_writer_is_refused_and_changes_nothing(
    store: Store, make_cells: MakeCells, me: Owner, commit: Commit
) -> None:
    (cell,) = make_cells(0)
    hash = cell.hash
    store.add([cell])
    late = store.claim(hash, ELSEWHERE, 100, {})
    heard(store, 61)
    new = store.claim(hash, me, 100, {})
    commit(store, hash, new, 1, metrics=[Metric("return", 1.0)], checkpoint=checkpoint(1))
    file = store.folder(hash) / "checkpoints" / "1.0.pt"
    file.parent.mkdir(parents=True)
    file.write_bytes(b"")
    before = (store.cells(), store.metrics(), store.checkpoints(hash), store.attempts(hash))
    writes: list[Callable[[int], None]] = [
        lambda n: store.beat(hash, n, "late", 0.5),
        lambda n: commit(store, hash, n, 0, metrics=[Metric("return", 9.0)]),
        lambda n: store.forget_checkpoints(hash, n, keep=[]),
        lambda n: store.add_artifact(hash, n, "animation", file, 1),
        lambda n: store.end(hash, n, Outcome.FINISHED),
    ]
    for write in writes:
        for attempt in (late, new + 1):
            with pytest.raises(Fenced, match=f"attempt {attempt}"):
                write(attempt)
    assert before == (store.cells(), store.metrics(), store.checkpoints(hash), store.attempts(hash))
    assert file.exists()

    store.end(hash, new, Outcome.FINISHED)
    for write in writes:
        with pytest.raises(Fenced, match="has ended"):
            write(new)


# Results

NUMBERS = [0.1, -1e308, 5e-324, 0.0, math.nan, math.inf, -math.inf]


def test_numbers_come_back_bit_for_bit_finite_or_not(claimed: Claimed, commit: Commit) -> None:
    store, hash, attempt = claimed
    values = np.array(NUMBERS)
    metrics = [Metric(f"m{i}", x, "noise_free", values) for i, x in enumerate(NUMBERS)]
    commit(store, hash, attempt, 2, metrics=metrics)
    found = store.metrics(values=True)
    kinds = ["finite"] * 4 + ["nan", "+inf", "-inf"]
    assert [row["kind"] for row in found] == kinds
    assert [np.float64(row["value"]).tobytes() for row in found] == [x.tobytes() for x in values]
    for row in found:
        assert row["values"].dtype == np.float64
        assert row["values"].tobytes() == values.tobytes()


def test_a_metric_row_says_where_it_belongs(claimed: Claimed, commit: Commit) -> None:
    store, hash, attempt = claimed
    commit(store, hash, attempt, 2, metrics=[Metric("loss", np.float32(0.5).item())])
    assert store.metrics(values=True) == [
        {
            "cell": hash,
            "task": "nav",
            "method": "solar",
            "variant": "default",
            "seed": 0,
            "iteration": 2,
            "episodes": 20,
            "steps": 1000,
            "simulated_seconds": 50.0,
            "seconds": 3.0,
            "split": "train",
            "name": "loss",
            "value": 0.5,
            "kind": "finite",
            "values": None,
        }
    ]
    assert "values" not in store.metrics()[0]


def test_metrics_are_sorted_and_selected(
    claimed: Claimed, make_cells: MakeCells, me: Owner, commit: Commit
) -> None:
    store, hash, attempt = claimed
    (other,) = make_cells(1, method="vae")
    store.add([other])
    second = store.claim(other.hash, me, 9, {})
    both = [
        Metric("return", 2.0, "noise_free"),
        Metric("return", 1.0),
        Metric("elbo", 0.0, "model"),
    ]
    for iteration in (0, 1, 10):
        commit(store, other.hash, second, iteration, metrics=both)
        commit(store, hash, attempt, iteration, metrics=both)
    keys = [(r["method"], r["iteration"], r["split"], r["name"]) for r in store.metrics()]
    assert keys == sorted(keys)
    assert len(keys) == 18
    assert len(store.metrics(names=["elbo"])) == 6
    assert len(store.metrics(splits=["train", "model"], hashes=[hash])) == 6
    assert {r["seed"] for r in store.metrics(methods=["vae"])} == {1}
    assert store.metrics(seeds=[1], tasks=["car"]) == []


def test_a_commit_replaces_what_was_stored_of_its_place_and_later(
    claimed: Claimed, commit: Commit
) -> None:
    store, hash, attempt = claimed
    for iteration in range(4):
        metrics = [Metric("return", float(iteration)), Metric("old", 0.0)]
        commit(store, hash, attempt, iteration, metrics=metrics, checkpoint=checkpoint(iteration))
    commit(store, hash, attempt, 2, metrics=[Metric("return", 7.0)], checkpoint=checkpoint(2))
    found = [(r["iteration"], r["name"], r["value"]) for r in store.metrics()]
    assert found == [
        (0, "old", 0.0),
        (0, "return", 0.0),
        (1, "old", 0.0),
        (1, "return", 1.0),
        (2, "return", 7.0),
    ]
    assert [c.iteration for c in store.checkpoints(hash)] == [2, 1, 0]
    record = store.find(hash)
    assert (record.iteration, record.episodes, record.steps, record.seconds) == (2, 20, 1000, 3.0)


def test_a_commit_inside_an_iteration_keeps_what_came_before(
    claimed: Claimed, commit: Commit
) -> None:
    store, hash, attempt = claimed
    commit(store, hash, attempt, 1, metrics=[Metric("return", 1.0)], checkpoint=checkpoint(1, 9))
    for position in (0, 1):
        inside = checkpoint(2, position, complete=False)
        commit(store, hash, attempt, 2, checkpoint=inside, episodes=17)
    newest = [(c.iteration, c.position, c.complete) for c in store.checkpoints(hash)]
    assert newest == [(2, 1, False), (2, 0, False), (1, 9, True)]
    assert store.checkpoints(hash)[2] == checkpoint(1, 9)
    assert [row["iteration"] for row in store.metrics()] == [1]
    assert store.find(hash).episodes == 17


def test_a_commit_is_stored_whole_or_not_at_all(claimed: Claimed, commit: Commit) -> None:
    store, hash, attempt = claimed
    commit(store, hash, attempt, 1, metrics=[Metric("return", 1.0)], checkpoint=checkpoint(1))
    before = (store.cells(), store.metrics(), store.checkpoints(hash))

    @event.listens_for(store._database._engine, "before_cursor_execute")
    def fail(_c: object, _k: object, statement: str, *_: object) -> None:
        if statement.startswith("INSERT INTO checkpoint"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        commit(store, hash, attempt, 1, metrics=[Metric("return", 2.0)], checkpoint=checkpoint(1))
    event.remove(store._database._engine, "before_cursor_execute", fail)
    assert before == (store.cells(), store.metrics(), store.checkpoints(hash))


@pytest.mark.parametrize(
    ("metrics", "point", "fault"),
    [
        ([Metric("a", 1.0), Metric("a", 2.0)], None, "twice"),
        ([Metric("a", 1.0)], checkpoint(2), "iteration 2"),
        ([Metric("a", 1.0)], checkpoint(3, complete=False), "end of an iteration"),
        ([], CheckpointRecord("../x.pt", "", 0, 3, 0, 0, True), "leaves"),
        ([], CheckpointRecord("/x.pt", "", 0, 3, 0, 0, True), "leaves"),
    ],
)
def test_a_commit_that_no_worker_means_is_refused(
    metrics: list[Metric], point: CheckpointRecord | None, fault: str, sqlite_store: Store
) -> None:
    with pytest.raises(ValueError, match=fault):
        sqlite_store.commit(
            "any",
            1,
            iteration=3,
            episodes=0,
            steps=0,
            simulated_seconds=0.0,
            seconds=0.0,
            metrics=metrics,
            checkpoint=point,
        )


def test_forgetting_deletes_old_checkpoints_and_what_killed_writers_left(
    claimed: Claimed, commit: Commit
) -> None:
    store, hash, attempt = claimed
    folder = store.folder(hash) / "checkpoints"
    folder.mkdir(parents=True)
    for iteration in range(4):
        (folder / f"{iteration}.0.pt").write_bytes(b"")
        commit(store, hash, attempt, iteration, checkpoint=checkpoint(iteration))
    (folder / ".9.0.pt.123").write_bytes(b"")
    (folder / "9.0.pt").write_bytes(b"")
    store.forget_checkpoints(hash, attempt, keep=["checkpoints/1.0.pt", "checkpoints/3.0.pt"])
    assert [c.iteration for c in store.checkpoints(hash)] == [3, 1]
    assert sorted(path.name for path in folder.iterdir()) == ["1.0.pt", "3.0.pt"]


def test_an_artifact_replaces_the_one_of_its_kind(claimed: Claimed) -> None:
    store, hash, attempt = claimed
    folder = store.folder(hash)
    folder.mkdir(parents=True)
    for name, kind, iteration in [("a", "animation", 1), ("b", "animation", 2), ("c", "other", 2)]:
        (folder / name).write_bytes(name.encode())
        store.add_artifact(hash, attempt, kind, folder / name, iteration)
    animation, other = store.artifacts(hash)
    assert (animation.kind, animation.iteration, animation.path) == ("animation", 2, folder / "b")
    # sha256 of the one byte "b", from `printf b | sha256sum`
    assert animation.sha256.startswith("3e23e8160039594a33894f6564e1b134")
    assert animation.bytes == 1
    assert not (folder / "a").exists()
    assert store.artifacts(kind="other") == [other]
    with pytest.raises(ValueError, match="subpath"):
        store.add_artifact(hash, attempt, "animation", folder.parent / "elsewhere", 2)


def test_hostile_text_comes_back_or_is_made_harmless(claimed: Claimed, commit: Commit) -> None:
    store, hash, attempt = claimed
    hostile = "'; DROP TABLE cell; -- <b>\x1b[31m é 猫"
    store.beat(hash, attempt, hostile, 0.0)
    commit(store, hash, attempt, 0, metrics=[Metric(hostile, 1.0)])
    store.end(hash, attempt, Outcome.FAILED, error=f"{hostile}\0\udc80")
    last = store.find(hash).last_attempt
    assert last is not None
    assert (last.activity, last.error) == (hostile, f"{hostile}\ufffd?")
    assert store.metrics(names=[hostile])[0]["value"] == 1.0


def test_a_cell_whose_method_is_gone_can_still_be_read(claimed: Claimed) -> None:
    store, hash, _ = claimed
    before = store.find(hash).cell
    with store._database.writing() as session:
        session.execute(text("UPDATE cell SET method = 'gone'"))
    after = store.find(hash).cell
    assert after.hash == hash
    assert after.config() == before.config()
    assert after.configuration.task == before.configuration.task
    assert after.title == "nav/gone seed 0"


def test_a_cell_can_still_be_read_when_a_value_of_its_settings_is_gone(claimed: Claimed) -> None:
    store, hash, _ = claimed
    before = store.find(hash).cell
    old = text("UPDATE cell SET configuration = replace(configuration, 'convex', 'lbfgs')")
    with store._database.writing() as session:
        session.execute(old)
    after = store.find(hash).cell
    assert (after.hash, after.title) == (hash, before.title)
    assert after.config()["method"]["cost_fit"]["optimiser"] == "lbfgs"
    assert after.configuration.task == before.configuration.task


def test_the_doctor_finds_a_sound_database_sound(claimed: Claimed) -> None:
    store, *_ = claimed
    report = store.diagnose()
    assert int(report["bytes"]) > 10_000
    if store._database.sqlite:
        assert report["integrity"] == report["references"] == "ok"
        assert report["journal"] == "delete"
    else:
        assert report["PostgreSQL"][0].isdigit()
