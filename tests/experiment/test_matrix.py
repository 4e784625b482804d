"""What is done with a cell follows from what is stored of it, and is said in one phrase."""

from collections.abc import Callable
from typing import Any

import pytest

from solar_cli.experiment.matrix import Action, is_stale, plan
from solar_cli.settings import Cell
from solar_cli.store.owner import Owner
from solar_cli.store.records import Outcome, State
from solar_cli.store.store import Store

HERE = {"version": "1", "commit": "a" * 40, "dirty": False, "diff_sha256": None}
ELSEWHERE = HERE | {"commit": "b" * 40}
EDITED = HERE | {"dirty": True, "diff_sha256": "c" * 64}
GONE = Owner("here", 1, -1.0, Owner.current().boot)  # no process has started before the boot
SHORT, DESK = 8, 12


@pytest.fixture
def cell(make_cells: Callable[..., list[Cell]]) -> Cell:
    return make_cells()[0]


def past(
    store: Store,
    cell: Cell,
    outcome: Outcome | None,
    episodes: int = DESK,
    owner: Owner | None = None,
    code: dict[str, Any] = HERE,
) -> None:
    """An attempt at the cell."""
    store.add([cell])
    number = store.claim(cell.hash, owner or Owner.current(), DESK, code)
    store.commit(
        cell.hash,
        number,
        iteration=episodes // 4,
        episodes=episodes,
        steps=0,
        simulated_seconds=0.0,
        seconds=1.0,
    )
    if outcome is not None:
        store.end(cell.hash, number, outcome, "it broke")


def decided(store: Store, cell: Cell, **how: Any) -> tuple[Action, str]:
    [one] = plan(store, [cell], present=how.pop("present", HERE), **how)
    return one.action, one.why


def test_a_new_cell_is_run_whether_the_store_knows_it_or_not(store: Store, cell: Cell) -> None:
    assert decided(store, cell)[0] is Action.RUN
    store.add([cell])
    assert decided(store, cell)[0] is Action.RUN
    assert decided(store, cell, redo=True, retry=True)[0] is Action.RUN


def test_a_finished_cell_is_skipped_until_more_is_wanted(store: Store, cell: Cell) -> None:
    past(store, cell, Outcome.FINISHED)
    assert decided(store, cell)[0] is Action.SKIP
    assert decided(store, cell, wanted=SHORT)[0] is Action.SKIP
    assert decided(store, cell, retry=True)[0] is Action.SKIP
    assert decided(store, cell, wanted="full") == (Action.CONTINUE, "has 12 of 16 episodes")
    assert decided(store, cell, redo=True)[0] is Action.REDO


def test_one_episode_is_said_as_one(store: Store, cell: Cell) -> None:
    past(store, cell, Outcome.FINISHED, episodes=1)
    assert decided(store, cell, wanted=1) == (Action.SKIP, "finished with 1 episode")
    assert decided(store, cell, redo=True) == (
        Action.REDO,
        "--redo discards 1 episode (finished)",
    )


def test_an_interrupted_cell_is_resumed(store: Store, cell: Cell) -> None:
    past(store, cell, Outcome.INTERRUPTED, episodes=8)
    action, why = decided(store, cell)
    assert action is Action.RESUME
    assert why == "interrupted in iteration 2, 8 of 12 episodes"


def test_a_cell_whose_owner_is_gone_is_interrupted_and_one_that_lives_is_blocked(
    store: Store, make_cells: Callable[..., list[Cell]]
) -> None:
    orphaned, running = make_cells(2)
    past(store, orphaned, None, owner=GONE)
    past(store, running, None)
    assert decided(store, orphaned)[0] is Action.RESUME
    assert decided(store, running, redo=True, retry=True)[0] is Action.BLOCKED
    assert "process" in decided(store, running)[1]


@pytest.mark.parametrize("outcome", [Outcome.FAILED, Outcome.DIVERGED])
def test_failed_and_diverged_cells_wait_for_retry(
    store: Store, cell: Cell, outcome: Outcome
) -> None:
    past(store, cell, outcome, episodes=8)
    action, why = decided(store, cell)
    assert action is Action.BLOCKED
    assert outcome.value in why
    assert "it broke" in why
    assert "--retry" in why
    assert decided(store, cell, retry=True)[0] is Action.RESUME
    assert decided(store, cell, redo=True)[0] is Action.REDO


@pytest.mark.parametrize("other", [ELSEWHERE, EDITED])
def test_a_cell_of_other_code_is_stale_and_rerun_only_with_redo(
    store: Store, cell: Cell, other: dict[str, Any]
) -> None:
    past(store, cell, Outcome.FINISHED, code=other)
    action, why = decided(store, cell)
    assert action is Action.STALE
    assert other["commit"][:7] in why
    assert decided(store, cell, retry=True)[0] is Action.STALE
    assert decided(store, cell, redo=True)[0] is Action.REDO
    assert decided(store, cell, present=other)[0] is Action.SKIP
    more, why = decided(store, cell, wanted="full")
    assert more is Action.CONTINUE
    assert other["commit"][:7] in why


def test_only_finished_cells_are_stale(store: Store, cell: Cell) -> None:
    past(store, cell, Outcome.FAILED, code=ELSEWHERE)
    record = store.find(cell.hash)
    assert record.state is State.FAILED
    assert not is_stale(record, HERE)


def test_plans_keep_the_order_of_the_cells_and_write_nothing(
    store: Store, make_cells: Callable[..., list[Cell]]
) -> None:
    cells = make_cells(5)[::-1]
    assert [one.cell for one in plan(store, cells, present=HERE)] == cells
    assert store.cells() == []
