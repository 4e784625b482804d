"""``solar run`` and what it says; the computing itself is the experiment's, and tested there."""

import json
from collections.abc import Callable, Sequence
from typing import Any

import pytest
from scenario import Solar, Stored
from stored_cells import store_attempt

from solar_cli.cli import progress
from solar_cli.cli.plans import print_results
from solar_cli.experiment import scheduler
from solar_cli.experiment.matrix import Action, Plan
from solar_cli.experiment.messages import Message
from solar_cli.experiment.scheduler import Event, Result
from solar_cli.settings import cells, load_card
from solar_cli.store.records import Outcome
from solar_cli.store.store import Store

SMOKE = ("run", "--task", "nav", "--method", "solar", "--variant", "smoke")


def test_a_dry_run_says_what_and_why_and_starts_nothing(solar: Solar, stored: Stored) -> None:
    before = stored.db.read_bytes()
    done = solar(*SMOKE, "--seeds", "6", "--dry-run", "--json", "--db", stored.db)
    entries = json.loads(done.out)
    assert [(entry["seed"], entry["action"]) for entry in entries] == [
        (0, "skip"),
        (1, "skip"),
        (2, "stale"),
        (3, "resume"),
        (4, "run"),
        (5, "run"),
    ]
    assert entries[0]["why"] == "finished with 16 episodes"
    # measured: 5 s for the 16 episodes of each finished cell; cell 3 has 8 of them
    assert [entry["seconds"] for entry in entries] == pytest.approx([0, 0, 0, 2.5, 5, 5])
    text = solar(*SMOKE, "--seeds", "6", "--dry-run", "--workers", "1", "--db", stored.db).out
    assert "3 of 6 cells to compute, 1 at a time: about 12 s; nothing was started" in text
    assert stored.db.read_bytes() == before
    # Together 12.5 s, but no cell takes less than 5.
    text = solar(*SMOKE, "--seeds", "6", "--dry-run", "--workers", "9", "--db", stored.db).out
    assert "9 at a time: about 5 s" in text


def test_a_dry_run_without_a_database_makes_none(solar: Solar, tmp_path: Any) -> None:
    done = solar(*SMOKE, "--dry-run", "--db", tmp_path / "new" / "solar.db")
    assert (done.code, "not yet computed" in done.out) == (0, True)
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "empty.db").touch()  # as a disk that was full leaves it
    done = solar(*SMOKE, "--dry-run", "--db", tmp_path / "empty.db")
    assert (done.code, "not yet computed" in done.out) == (0, True)
    assert (tmp_path / "empty.db").read_bytes() == b""


@pytest.mark.parametrize(
    ("options", "action"),
    [
        (("--seeds", "1", "--budget", "16"), "skip"),
        (("--seeds", "1", "--budget", "full"), "continue"),
        (("--seeds", "1", "--redo"), "redo"),
        (("--seeds", "3:4"), "resume"),
        (("--seeds", "1", "--set", "task.horizon=9"), "run"),
    ],
)
def test_what_is_asked_for_decides_what_is_done(
    solar: Solar, stored: Stored, options: tuple[str, ...], action: str
) -> None:
    [entry] = json.loads(solar(*SMOKE, *options, "--dry-run", "--json", "--db", stored.db).out)
    assert entry["action"] == action


def test_failed_cells_are_taken_up_only_with_retry(solar: Solar, stored: Stored) -> None:
    command = ("run", "--task", "nav", "--method", "vae", "--variant", "smoke", "--seeds", "2")
    plain = json.loads(solar(*command, "--dry-run", "--json", "--db", stored.db).out)
    assert [entry["action"] for entry in plain] == ["blocked", "blocked"]
    again = json.loads(solar(*command, "--retry", "--dry-run", "--json", "--db", stored.db).out)
    assert [entry["action"] for entry in again] == ["resume", "resume"]
    # nothing to compute, but cells are missing: that is a failure, with its causes
    done = solar(*command, "--db", stored.db)
    assert done.code == 1
    assert "NaN in the ELBO" in done.out
    assert "\x1b" not in done.out


def test_a_finished_matrix_is_left_alone(solar: Solar, stored: Stored) -> None:
    before = stored.db.read_bytes()
    done = solar(*SMOKE, "--seeds", "3", "--db", stored.db)
    assert done.code == 0
    assert "2 finished already, 1 stale" in done.out
    assert f"solar report --db {stored.db}" in done.out
    assert stored.db.read_bytes() == before


def test_tasks_methods_and_seeds_multiply_and_repeat_without_harm(
    solar: Solar, stored: Stored
) -> None:
    command = ("run", "--task", "nav", "--task", "nav-fixed", "--task", "nav", "--method", "solar")
    command += ("--method", "vae", "--variant", "smoke", "--seeds", "0:3", "--dry-run", "--json")
    entries = json.loads(solar(*command, "--db", stored.db).out)
    assert len(entries) == len({entry["cell"] for entry in entries}) == 2 * 2 * 3


def plans(count: int) -> list[Plan]:
    return [
        Plan(cell, 16, Action.RUN, "not yet computed")
        for cell in cells(load_card("nav"), "solar", range(count), "smoke")
    ]


Runner = Callable[..., list[Result]]


def fake_run(outcomes: Sequence[tuple[Outcome | None, str]]) -> Runner:
    """A scheduler that computes nothing: three messages a cell, then the given end."""

    def run(
        plans: Sequence[Plan], store: object, *, report: Callable[[Event], None], **_: object
    ) -> list[Result]:
        results = []
        for plan, (outcome, cause) in zip(plans, outcomes, strict=True):
            result = Result(plan, outcome, cause)
            report(Event("started", plan))
            for share in (0.1, 0.2, 0.3):
                message = Message(1, 8, 0.25, "training", share)
                report(Event("progress", plan, message, 30.0))
            report(Event("ended", plan, message, result=result))
            results.append(result)
        return results

    return run


def test_a_run_tells_what_happens_and_fails_when_a_cell_does(
    solar: Solar, tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    ends = [(Outcome.FINISHED, ""), (Outcome.FAILED, "out of \x1b[1m memory"), (None, "stopped")]
    monkeypatch.setattr(scheduler, "run", fake_run(ends))
    done = solar(*SMOKE, "--seeds", "3", "--db", tmp_path / "solar.db")
    assert done.code == 1
    assert "\x1b" not in done.out
    assert done.out.count("iteration 1, 8/16 episodes, final_distance 0.25, 30 s left") == 3
    assert "nav/solar:smoke seed 0: finished" in done.out
    assert "1 finished, 1 failed, 1 not started" in done.out
    causes = done.out[done.out.index("Not finished") :]
    assert "out of" in causes
    assert "solar show" in causes


def test_a_run_in_json_is_one_object_a_line_and_ends_with_a_summary(
    solar: Solar, tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scheduler, "run", fake_run([(Outcome.FINISHED, "")] * 2))
    done = solar(*SMOKE, "--seeds", "2", "--json", "--db", tmp_path / "solar.db")
    assert done.code == 0
    events = [json.loads(line) for line in done.out.splitlines()]
    kinds = [event["event"] for event in events]
    assert kinds == ["plan", *["started", "progress", "ended"] * 2, "summary"]
    assert events[-1]["finished"]
    assert events[-1]["counts"] == {"finished": 2}
    assert events[2]["value"] == 0.25


def test_the_live_table_has_a_row_for_each_running_cell() -> None:
    first, second, _ = plans(3)
    board = progress.Board(3)
    assert not board.take(Event("started", first))
    assert not board.take(Event("started", second))
    board.take(Event("progress", first, Message(2, 12, 0.125, "training [red]", 0.5), 90.0))
    table = board.table()
    assert (table.row_count, str(table.title)) == (2, "2 running, 1 waiting, 0 ended")
    assert progress.row(board.running[first.cell.hash]) == (
        "nav/solar:smoke seed 0",
        2,
        "12/16",
        "final_distance 0.125",
        "training [red] 50%",
        "1 min 30 s",
    )
    assert board.take(Event("ended", first, result=Result(first, Outcome.FINISHED, "")))
    assert board.table().row_count == 1


def test_a_log_has_a_line_an_iteration_not_one_a_message() -> None:
    [plan], seen = plans(1), []
    lines = progress.Lines(seen.append)
    for iteration in (0, 0, 1, 1, 1, 2):
        lines(Event("progress", plan, Message(iteration, 0, None, "training", 0.5)))
    assert [event.message.iteration for event in seen if event.message] == [0, 1, 2]


def test_before_a_worker_has_read_its_checkpoint_the_stored_progress_is_told(
    solar: Solar, stored: Stored
) -> None:
    from solar_cli.experiment.matrix import plan
    from solar_cli.store.store import Store

    with Store.open(str(stored.db), read_only=True) as store:
        [resumed] = plan(store, [stored.interrupted], 16)
    told = progress.plain_line(Event("progress", resumed, Message(0, 0, None, "starting", 0.0)))
    assert "iteration 1, 8/16 episodes" in told
    told = progress.plain_line(Event("progress", resumed, Message(2, 8, None, "training", 0.0)))
    assert "iteration 2, 8/16 episodes" in told
    assert progress.row(Event("started", resumed))[2] == "8/16"


@pytest.mark.parametrize("end", [(Outcome.INTERRUPTED, "stopped"), (None, "not started")])
def test_after_an_interruption_the_same_command_is_said_to_go_on(
    solar: Solar,
    tmp_path: Any,
    monkeypatch: pytest.MonkeyPatch,
    end: tuple[Outcome | None, str],
) -> None:
    monkeypatch.setattr(scheduler, "run", fake_run([end]))
    out = solar(*SMOKE, "--db", tmp_path / "solar.db").out
    assert "same command" in out[out.index("next:") :].splitlines()[1]
    monkeypatch.setattr(scheduler, "run", fake_run([(Outcome.FAILED, "broken")]))
    out = solar(*SMOKE, "--db", tmp_path / "solar.db").out
    assert "same command" not in out
    assert "--retry" in out[out.index("next:") :]


def test_the_next_step_after_an_interruption_keeps_what_was_computed(
    solar: Solar, stored: Stored, monkeypatch: pytest.MonkeyPatch
) -> None:
    def steps(ends: Sequence[tuple[Outcome | None, str]], *options: str) -> list[str]:
        monkeypatch.setattr(scheduler, "run", fake_run(ends))
        out = solar(*SMOKE, "--seeds", str(len(ends)), *options, "--db", stored.db).out
        return [line.strip() for line in out[out.index("next:") :].splitlines()[1:]]

    request, waiting = (Outcome.INTERRUPTED, "stopped on request"), (None, scheduler.STOPPED)
    first, second, *_ = steps([request, waiting], "--redo")
    assert first.startswith("the same command without --redo")
    assert second.endswith("--seeds 1,")
    lost = (Outcome.INTERRUPTED, "checkpoints are missing or damaged")
    assert steps([lost], "--budget", "99")[0].startswith("once the cause is put right, the same")


def test_the_next_step_tells_no_password(capsys: pytest.CaptureFixture[str]) -> None:
    [plan] = plans(1)
    for outcome in (Outcome.FINISHED, Outcome.FAILED):
        results = [Result(plan, outcome, "")]
        print_results(results, False, "postgresql://me:hunter2@host/solar")
        out = capsys.readouterr().out
        assert f"solar show {plan.cell.hash[:8]} --db 'postgresql://me:***@host/solar'" in out
        assert "hunter2" not in out


def test_a_cell_of_another_run_is_said_to_be_awaited(solar: Solar, stored: Stored) -> None:
    with Store.open(str(stored.db)) as store:
        store_attempt(store, stored.interrupted, [], None, {})
        out = solar(*SMOKE, "--seeds", "3:4", "--db", stored.db).out
    assert "the same command again, once the other run has ended" in out
    done = Event("ended", plans(1)[0], result=Result(plans(1)[0], None, scheduler.STOPPED))
    assert progress.plain_line(done).endswith("seed 0: not started, the run was stopped")


def test_one_cell_is_not_spoken_of_as_several(solar: Solar, stored: Stored) -> None:
    out = solar(*SMOKE, "--dry-run", "--db", stored.db).out
    assert "1 cell and nothing to compute" in out
    assert "1 of 1 cell to compute" in solar(*SMOKE, "--seeds", "7:8", "--dry-run").out
