"""Several runs of one matrix at once, and runs that cannot end well."""

from collections.abc import Callable

from disturbed import PATIENCE, Matrix, Undisturbed

from solar_cli.store.records import State
from solar_cli.store.store import Store


def test_two_schedulers_compute_each_cell_once(
    matrix: Callable[[int], Matrix], undisturbed: Undisturbed
) -> None:
    run = matrix(2)
    both = [run.start(checkpoint_seconds=60.0) for _ in range(2)]
    for scheduler in both:
        scheduler.wait(timeout=PATIENCE)
    assert 0 in {scheduler.returncode for scheduler in both}
    assert run.fingerprints() == undisturbed.fingerprints
    with Store.open(run.db) as store:
        for record in store.cells():
            assert len(store.attempts(record.hash)) == 1
            assert record.state is State.FINISHED


def test_training_that_leaves_the_finite_numbers_ends_as_diverged(
    matrix: Callable[[int], Matrix],
) -> None:
    run = matrix(1)
    scheduler = run.start(sets=["methods.solar.training.learning_rate=1e30"])
    assert scheduler.wait(timeout=PATIENCE) == 1
    with Store.open(run.db) as store:
        [record] = store.cells()
        assert record.state is State.DIVERGED
        assert record.last_attempt is not None
        assert "iteration 1" in (record.last_attempt.error or "")
        assert {row["iteration"] for row in store.metrics()} == {0}
