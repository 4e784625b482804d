"""What cells will take is measured on finished cells that differ in their seed only."""

from collections.abc import Callable

import pytest

from solar_cli.experiment.estimates import WORKER_BYTES, Estimate, estimate, measured_speeds
from solar_cli.experiment.matrix import Action, Plan
from solar_cli.settings import Cell
from solar_cli.store.owner import Owner
from solar_cli.store.records import Outcome
from solar_cli.store.store import Store


def computed(
    store: Store, cell: Cell, episodes: int, seconds: float, outcome: Outcome = Outcome.FINISHED
) -> None:
    store.add([cell])
    number = store.claim(cell.hash, Owner.current(), episodes, {})
    store.commit(
        cell.hash,
        number,
        iteration=1,
        episodes=episodes,
        steps=0,
        simulated_seconds=0.0,
        seconds=seconds,
    )
    store.end(cell.hash, number, outcome)
    store.folder(cell.hash).mkdir(parents=True)
    (store.folder(cell.hash) / "file").write_bytes(bytes(episodes * 10))


def test_time_and_disk_follow_the_pace_of_finished_seeds(
    store: Store, make_cells: Callable[..., list[Cell]]
) -> None:
    one, two, broken, new, half = make_cells(5)
    computed(store, one, 10, 20.0)
    computed(store, two, 30, 100.0)  # together 3 seconds an episode, 10 bytes an episode
    computed(store, broken, 10, 9999.0, Outcome.FAILED)
    computed(store, half, 25, 9999.0, Outcome.INTERRUPTED)
    plans = [
        Plan(new, 100, Action.RUN, "why"),
        Plan(half, 100, Action.RESUME, "why", store.find(half.hash)),
        Plan(half, 100, Action.REDO, "why", store.find(half.hash)),
        Plan(one, 10, Action.SKIP, "why", store.find(one.hash)),
    ]
    assert estimate(store, plans) == [
        Estimate(300.0, WORKER_BYTES, 1000),
        Estimate(225.0, WORKER_BYTES, 1000),
        Estimate(300.0, WORKER_BYTES, 1000),
        Estimate(0.0, 0, 0),
    ]


def test_nothing_is_known_of_another_variant(
    store: Store, make_cells: Callable[..., list[Cell]]
) -> None:
    [seen], [other] = make_cells(1), make_cells(1, steps=5)
    assert seen.variant != other.variant
    computed(store, seen, 10, 20.0)
    [found] = estimate(store, [Plan(other, 100, Action.RUN, "why")])
    assert found == Estimate(None, WORKER_BYTES, None)
    assert measured_speeds(store, [seen, other]) == {
        (seen.task, seen.method, seen.variant): pytest.approx(2.0)
    }
