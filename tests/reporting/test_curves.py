"""The rules of evidence about curves, each by a case small enough to check by eye."""

import numpy as np
import pytest
from hand_made import CODE, HIGHER, cell, compute, curve, database, record, seed

from solar_cli.reporting.curves import problems, seed_curve
from solar_cli.store.records import Outcome, State


def test_seeds_share_the_union_of_their_counts_and_keep_their_last_value_in_between():
    both = curve(
        seed(0, [(0, 8.0), (20, 4.0), (40, 2.0)]), seed(1, [(0, 6.0), (30, 0.0), (40, 0.0)])
    )
    assert both.grid.tolist() == [0, 20, 30, 40]
    assert both.values.tolist() == [[8, 4, 4, 2], [6, 6, 0, 0]]
    assert both.mean.tolist() == [7, 5, 2, 1]


def test_a_curve_ends_where_its_shortest_seed_ends():
    both = curve(seed(0, [(0, 8.0), (20, 4.0), (40, 2.0)]), seed(1, [(0, 6.0), (20, 2.0)]))
    assert both.end == 20
    assert both.final.tolist() == [4, 2]


def test_a_curve_begins_where_all_seeds_have_a_value():
    both = curve(seed(0, [(0, 8.0), (20, 4.0)]), seed(1, [(10, 6.0), (20, 2.0)]))
    assert both.grid.tolist() == [10, 20]
    assert both.values[0].tolist() == [8, 4]


@pytest.mark.parametrize(
    ("points", "kept_at"),
    [([(0, 5.0), (10, 3.0)], 5.0), ([(0, 5.0), (10, 9.0)], 9.0)],
    ids=["its start is worse", "its end is worse"],
)
def test_a_diverged_seed_stays_in_at_the_worse_of_its_start_and_its_end(points, kept_at):
    steady = seed(0, [(0, 5.0), (10, 1.0), (20, 1.0), (30, 1.0)])
    both = curve(steady, seed(1, points, State.DIVERGED))
    assert both.grid.tolist() == [0, 10, 20, 30]
    assert both.values[1].tolist() == [5, points[1][1], kept_at, kept_at]


def test_where_higher_is_better_the_worse_value_is_the_lower_one():
    diverged = seed(1, [(0, -5.0), (10, -3.0)], State.DIVERGED, HIGHER)
    both = curve(seed(0, [(0, -5.0), (20, -1.0)], measure=HIGHER), diverged)
    assert both.final.tolist() == [-1, -5]


def test_a_curve_of_diverged_seeds_only_goes_on_to_the_last_of_them():
    both = curve(
        seed(0, [(0, 5.0), (10, 3.0)], State.DIVERGED),
        seed(1, [(0, 4.0), (20, 6.0)], State.DIVERGED),
    )
    assert both.grid.tolist() == [0, 10, 20]
    assert both.final.tolist() == [5, 6]


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_value_that_is_not_finite_is_a_divergence_whatever_the_run_became(bad):
    broken = seed(1, [(0, 5.0), (10, 3.0), (20, bad), (30, 1.0)], State.FINISHED)
    assert broken.diverged
    assert broken.values.tolist() == [5, 3]
    assert broken.on(np.array([30])).tolist() == [5]


def test_a_cell_without_a_finite_value_has_no_curve():
    assert seed_curve(record(cell()), [(0, np.nan)], HIGHER) is None
    assert seed_curve(record(cell()), [], HIGHER) is None


def test_std_over_seeds_is_the_sample_one_and_none_for_a_single_seed():
    three = curve(*(seed(i, [(0, value)]) for i, value in enumerate([1.0, 2.0, 3.0])))
    assert three.std.tolist() == [1.0]  # sqrt((1 + 0 + 1) / 2)
    alone = curve(seed(0, [(0, 1.0)]))
    assert (three.final_std, alone.std, alone.final_std) == (1.0, None, None)


def test_a_level_is_reached_at_the_first_evaluation_that_is_at_least_as_good():
    lower = seed(0, [(0, 1.0), (10, 0.5), (20, 0.7), (30, 0.4)])
    assert [lower.first_reaching(level) for level in (0.5, 0.45, 0.1)] == [10, 30, None]
    higher = seed(0, [(0, -3.0), (10, -1.0)], measure=HIGHER)
    assert higher.first_reaching(-1.0) == 10


def test_a_level_not_reached_is_bounded_by_how_far_the_seed_was_seen():
    seeds = (
        seed(0, [(0, 1.0), (40, 0.1)]),
        seed(1, [(0, 1.0), (30, 0.9)]),
        seed(2, [(0, 1.0), (10, 0.9)], State.DIVERGED),  # known to be worse up to the curve's end
    )
    assert curve(*seeds).bounds(0.5).tolist() == [[40, 40], [30, np.inf], [30, np.inf]]


def labels(store):
    return {problem.title: [c.label for c in problem.curves] for problem in problems(store)}


def test_two_variants_are_never_one_curve(tmp_path):
    with database(tmp_path) as store:
        compute(store, cell("solar", 0), [1.0, 0.5])
        compute(store, cell("solar", 0, "paper"), [1.0, 0.9])
        compute(store, cell("vae", 0), [1.0, 0.7])
        assert labels(store) == {"nav": ["solar", "solar:paper", "vae"]}


def test_two_configurations_under_one_name_are_two_curves(tmp_path):
    old = cell("solar", 0, "mine", "methods.solar.update.kl_step=1.0")
    new = cell("solar", 1, "mine", "methods.solar.update.kl_step=2.0")
    with database(tmp_path) as store:
        compute(store, old, [1.0, 0.5])
        compute(store, new, [1.0, 0.1])
        (problem,) = problems(store)
    newest, older = sorted(problem.curves, key=lambda curve: len(curve.label))
    assert (newest.label, newest.final.tolist()) == ("solar:mine", [0.1])
    assert older.label == f"solar:mine@{older.key[:6]}"
    assert older.final.tolist() == [0.5]


def test_another_horizon_is_another_problem_and_another_observation_is_not(tmp_path):
    with database(tmp_path) as store:
        compute(store, cell("solar", 0), [1.0, 0.5])
        compute(store, cell("solar", 0, "short", "task.horizon=10"), [1.0, 0.9])
        compute(store, cell("solar", 0, "two", "task.observation.window=2"), [1.0, 0.8])
        assert labels(store) == {"nav": ["solar", "solar:two"], "nav:short": ["solar:short"]}


def test_cells_without_an_evaluation_are_pending_not_forgotten(tmp_path):
    with database(tmp_path) as store:
        compute(store, cell("solar", 0), [1.0, 0.5])
        store.add([cell("solar", 1), cell("vae", 0)])
        (problem,) = problems(store)
    assert [r.cell.title for r in problem.pending] == ["nav/vae seed 0"]
    (only,) = problem.curves
    assert len(only.seeds) == 1
    assert only.count(State.PENDING) == 1


def test_evaluations_of_other_splits_and_measures_stay_out(tmp_path):
    with database(tmp_path) as store:
        compute(store, cell(), [1.0, 0.5], train={"final_distance": [99.0], "return": [-7.0]})
        (problem,) = problems(store)
    assert problem.curves[0].mean.tolist() == [1.0, 0.5]


def test_a_stored_diverged_cell_is_a_diverged_seed(tmp_path):
    with database(tmp_path) as store:
        compute(store, cell(seed=0), [1.0, 0.5, 0.2])
        compute(store, cell(seed=1), [1.0, 0.8], Outcome.DIVERGED, CODE, "not finite")
        (problem,) = problems(store)
    assert problem.curves[0].final.tolist() == [0.2, 1.0]
