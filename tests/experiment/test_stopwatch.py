"""Seconds are counted once, to the innermost activity, and to the iteration they were spent on."""

import time
from collections.abc import Callable
from typing import Any

import fake_method
import pytest
from test_session import TARGET, Boss, attempt

from solar_cli import stopwatch
from solar_cli.experiment.judge import Judge
from solar_cli.experiment.session import Stopped
from solar_cli.settings import Cell
from solar_cli.stopwatch import Stopwatch
from solar_cli.store.store import Store

NAP = 0.03


class Clock:
    """A clock that is set by hand."""

    now = 100.0

    def monotonic(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    monkeypatch.setattr(stopwatch, "time", made)
    return made


def test_what_runs_inside_an_activity_is_not_counted_to_it(clock: Clock) -> None:
    watch = Stopwatch()
    clock.now += 7.0  # nothing runs
    with watch.running("outer"):
        clock.now += 1.0
        with watch.running("inner"):
            clock.now += 10.0
            with watch.running("outer"):
                clock.now += 0.5
        clock.now += 2.0
        assert watch.seconds() == {"outer": 3.5, "inner": 10.0}
        clock.now += 4.0
    clock.now += 7.0
    assert watch.seconds() == {"outer": 7.5, "inner": 10.0}


def test_an_activity_ends_where_an_exception_leaves_it(clock: Clock) -> None:
    watch = Stopwatch()

    @watch.running("outer")
    @watch.running("inner")
    def fail() -> None:
        clock.now += 1.0
        raise KeyError

    with pytest.raises(KeyError):
        fail()
    clock.now += 5.0
    assert watch.seconds() == {"outer": 0.0, "inner": 1.0}


def test_every_call_of_a_decorated_function_counts(clock: Clock) -> None:
    watch = Stopwatch()

    @watch.running("calling")
    def call(seconds: float) -> float:
        clock.now += seconds
        return seconds

    assert [call(1.0), call(2.0)] == [1.0, 2.0]
    assert watch.seconds() == {"calling": 3.0}


def test_counting_goes_on_from_saved_seconds(clock: Clock) -> None:
    watch = Stopwatch()
    with watch.running("outer"):
        clock.now += 1.0
        watch.go_on_from({"outer": 20.0, "inner": 3.0})
        clock.now += 1.0
    assert watch.seconds() == {"outer": 21.0, "inner": 3.0}


def spent(store: Store, cell: Cell) -> dict[int, dict[str, float]]:
    """The seconds of each iteration by activity."""
    found: dict[int, dict[str, float]] = {}
    for row in store.metrics(hashes=[cell.hash], splits=["train"]):
        if row["name"].startswith("seconds_") and row["name"] != "seconds_walking":
            activity = row["name"].removeprefix("seconds_")
            found.setdefault(row["iteration"], {})[activity] = row["value"]
    return found


def slow(owner: Any, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every call takes a nap longer."""
    whole = getattr(owner, name)

    def napping(*given: Any, **named: Any) -> Any:
        time.sleep(NAP)
        return whole(*given, **named)

    monkeypatch.setattr(owner, name, napping)


@pytest.mark.parametrize(
    ("owner", "name", "activity"),
    [
        (fake_method.FakePolicy, "start", "collecting"),
        (fake_method.Fake, "_fail", "control"),
        (Judge, "evaluate", "evaluating"),
        (fake_method.Fake, "diagnose", "evaluating"),
        (Store, "commit", "saving"),
    ],
)
def test_each_iteration_knows_what_its_time_was_spent_on(
    store: Store,
    make_cells: Callable[..., list[Cell]],
    monkeypatch: pytest.MonkeyPatch,
    owner: Any,
    name: str,
    activity: str,
) -> None:
    cell = make_cells()[0]
    slow(owner, name, monkeypatch)
    attempt(store, cell, every=1e9)
    found = spent(store, cell)
    assert sorted(found) == [0, 1, 2, 3]
    for iteration in (1, 2, 3):
        assert set(found[iteration]) == {"collecting", "control", "evaluating", "saving"}
        assert found[iteration][activity] >= NAP
    assert sum(sum(seconds.values()) for seconds in found.values()) <= store.find(cell.hash).seconds


def test_what_a_method_trains_is_not_counted_twice(
    store: Store, make_cells: Callable[..., list[Cell]], monkeypatch: pytest.MonkeyPatch
) -> None:
    cell = make_cells()[0]
    whole = fake_method.Fake.iterate

    def training(self: Any, environment: Any) -> dict[str, float]:
        time.sleep(6 * NAP)
        trained = {"training": 2 * NAP, "discarded": NAP / 2, "judging": 3 * NAP}
        seconds = {f"seconds_{activity}": value for activity, value in trained.items()}
        return whole(self, environment) | seconds

    monkeypatch.setattr(fake_method.Fake, "iterate", training)
    attempt(store, cell, every=1e9)
    for iteration in (1, 2, 3):
        seconds = spent(store, cell)[iteration]
        assert (seconds["training"], seconds["judging"]) == (2 * NAP, 3 * NAP)
        assert NAP / 2 <= seconds["control"] < 2 * NAP


def test_an_interrupted_iteration_has_the_seconds_of_all_its_attempts(
    store: Store, make_cells: Callable[..., list[Cell]], monkeypatch: pytest.MonkeyPatch
) -> None:
    cell = make_cells()[0]
    # In each of an iteration's three steps.
    monkeypatch.setattr(fake_method.Fake, "_fail", lambda self, iteration: time.sleep(NAP))
    with pytest.raises(Stopped):
        attempt(store, cell, Boss(stop_at=2, activity="walking"), every=1e9)
    assert not store.checkpoints(cell.hash)[0].complete
    attempt(store, cell, every=1e9, target=TARGET)
    for iteration in (1, 2, 3):
        assert spent(store, cell)[iteration]["control"] >= 3 * NAP
