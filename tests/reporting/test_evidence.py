"""What must be said beside a curve is said."""

from hand_made import CODE, DIRTY_CODE, OTHER_CODE, cell, compute, curve, database, record, seed

from solar_cli.reporting.curves import problems
from solar_cli.reporting.evidence import codes, cut, notes
from solar_cli.reporting.summary import seeds, summarise, table
from solar_cli.store.records import Outcome, Owner, State

POINTS = [(0, 1.0), (10, 0.5)]


def said(*seeds, present=CODE, extra=()):
    return " / ".join(notes(None, curve(*seeds, extra=extra), present))


def test_a_clean_finished_curve_of_the_present_code_needs_no_note():
    assert said(seed(0, POINTS), seed(1, POINTS)) == ""


def test_seeds_of_different_commits_are_labelled():
    mixed = curve(seed(0, POINTS), seed(1, POINTS, provenance=OTHER_CODE))
    different, stale = notes(None, mixed, CODE)
    assert "different code in one curve: aaaaaaa (seed 0); bbbbbbb (seed 1)" in different
    assert "stale: aaaaaaa did not compute seed 1" in stale


def test_uncommitted_changes_are_labelled():
    text = said(seed(0, POINTS, provenance=DIRTY_CODE), present=DIRTY_CODE)
    assert "uncommitted changes: aaaaaaa with changes cccccc" in text


def test_diverged_failed_unfinished_and_missing_seeds_are_each_said():
    text = said(
        seed(0, POINTS),
        seed(1, [(0, 1.0)], State.DIVERGED),
        seed(2, POINTS, State.FAILED),
        seed(3, POINTS, State.RUNNING),
        extra=[record(cell(seed=4), State.FAILED, error="out of memory")],
    )
    assert "seed 1 diverged after 0 episodes and counts as 1" in text
    assert "seed 2 is failed at 10 episodes" in text
    assert "seed 3 is running at 10 episodes" in text
    assert "seed 4 is failed and has no value: it is left out: out of memory" in text


def test_a_curve_cut_by_a_short_seed_says_which():
    text = said(seed(0, [*POINTS, (20, 0.1)]), seed(1, POINTS))
    assert "ends at 10 of 20 episodes" in text
    assert "(seed 1)" in text
    assert cut(curve(seed(0, POINTS), seed(1, POINTS))) == []


def test_an_attempt_of_other_code_is_not_forgotten_when_a_later_one_finishes(tmp_path):
    of = cell()
    with database(tmp_path) as store:
        compute(store, of, [1.0], Outcome.INTERRUPTED, OTHER_CODE)
        attempt = store.claim(of.hash, Owner.current(), 100, CODE)
        store.end(of.hash, attempt, Outcome.FINISHED)
        (problem,) = problems(store)
        assert set(codes(store, problem.curves[0])) == {"aaaaaaa", "bbbbbbb"}


def test_the_table_of_results_counts_failures_and_bounds_levels(tmp_path):
    with database(tmp_path) as store:
        compute(store, cell(seed=0), [1.0, 0.4, 0.2])
        compute(store, cell(seed=1), [1.0, 0.6, 0.6])
        compute(store, cell(seed=2), [1.0, 0.9], Outcome.DIVERGED, error="nan")
        (problem,) = problems(store)
        summary = summarise(store, problem.curves[0], CODE, {cell(seed=1).hash: 3 * 2**20})
    assert seeds(summary) == "3 (1 diverged)"
    assert summary.mean == (0.2 + 0.6 + 1.0) / 3
    assert summary.episodes == 20
    levels = {found.level: (found.episodes.low, found.reached) for found in summary.levels}
    assert levels[0.5] == (20, 1)  # 10, and two lower bounds of 20
    row = dict(
        zip(table(problem, [summary]).columns, table(problem, [summary]).rows[0], strict=True)
    )
    assert row["episodes to 0.5"] == "> 20 (1/3)"
    assert row["episodes to 0.05"] == "> 20 (0/3)"
    assert row["peak memory"] == "3 MiB"
