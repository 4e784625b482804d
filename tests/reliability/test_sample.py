"""The kills of every kind, once: what `.ci/run` has time for. A minute or so on two cores."""

from collections.abc import Callable

from disturbed import Matrix, Undisturbed

KILLS = (  # in iteration 1, ...
    "collecting:7:both",
    "training:1:worker",
    "renamed:1:both",
    "updated:1:scheduler",
    "evaluating:4:both",
    "collected:1:worker",  # ... 2, ...
    "collecting:3:scheduler",
    "training:2:both",
    "committed:1:worker",
    "updated:1:both",  # ... and 3
    "renamed:1:scheduler",
    "evaluating:4:scheduler",
)


def test_the_run_after_any_kill_finishes_with_the_bits_of_an_undisturbed_one(
    matrix: Callable[[int], Matrix], undisturbed: Undisturbed
) -> None:
    run = matrix(1)
    for where in KILLS:
        run.die(where)
    assert all(result["finished"] for result in run.finish())
    found = run.fingerprints()
    assert found == {cell: undisturbed.fingerprints[cell] for cell in found}
