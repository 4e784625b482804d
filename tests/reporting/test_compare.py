"""Comparisons: signs, verdicts, what is compared with what."""

import json

import numpy as np
import pytest
from hand_made import cell, compute, database, flat_curve, problem

from solar_cli.errors import SolarError, UsageError
from solar_cli.reporting.compare import compare, compare_curves, judge
from solar_cli.settings import cells, load_card
from solar_cli.store.records import Outcome

NEAR = [0.10, 0.11, 0.12, 0.13]
FAR = [0.60, 0.61, 0.62, 0.63]


def pair(left, right):
    curves = flat_curve("vae", left), flat_curve("solar", right)
    return compare_curves(problem(*curves), *curves, [])


def test_the_numbers_of_a_pair_by_hand():
    found = pair(FAR, NEAR)
    assert found.difference == pytest.approx(0.5)
    assert found.improvement == 0.0
    assert found.p == pytest.approx(2 / 70)
    assert found.verdict == "worse"
    # Level 0.5: solar needs 100 episodes, vae was seen up to 100 and has not reached it.
    first = found.ratios[0]
    assert (first.level, first.ratio.low, first.ratio.high) == (0.5, 1.0, np.inf)


def test_swapping_the_sides_turns_every_number_round():
    one, other = pair(FAR, NEAR), pair(NEAR, FAR)
    assert other.difference == -one.difference
    assert other.improvement == 1 - one.improvement
    assert other.p == one.p
    assert other.verdict == "better"
    assert other.ratios[0].ratio.high == 1 / one.ratios[0].ratio.low


@pytest.mark.parametrize(
    ("better", "p", "seeds", "verdict"),
    [
        (1.0, 0.1, (3, 3), "undecided"),
        (1.0, 0.03, (4, 4), "better"),
        (0.0, 0.03, (4, 4), "worse"),
        (0.7, 0.2, (10, 10), "undecided"),
    ],
)
def test_a_verdict_needs_a_test_that_can_reach_its_level(better, p, seeds, verdict):
    assert judge(better, p, *seeds)[0] == verdict


def test_ends_at_unequal_episodes_are_told():
    short, long = flat_curve("vae", NEAR, 80), flat_curve("solar", FAR, 100)
    [note] = compare_curves(problem(short, long), short, long, []).notes
    assert "vae ends at 80 episodes, solar at 100" in note
    assert pair(NEAR, FAR).notes == ()


def test_too_few_seeds_are_named_as_the_reason():
    assert "cannot reach" in pair(FAR[:3], NEAR[:3]).why


def test_bare_every_method_and_variant_is_compared_with_solar(tmp_path):
    with database(tmp_path) as store:
        for seed in range(4):
            compute(store, cell("solar", seed), [1.0, NEAR[seed]])
            compute(store, cell("solar", seed, "paper"), [1.0, FAR[seed]])
            compute(store, cell("vae", seed), [1.0, FAR[seed]])
            for method in ("solar", "vae"):
                compute(store, cell(method, seed, "smoke"), [1.0, 0.9])
        found = compare(store)
        single = compare(store, "vae:default")
        smoke = compare(store, "vae:smoke", "solar:smoke")
    assert [(p.problem, p.left.label, p.right.label) for p in found.pairs] == [
        ("nav", "solar:paper", "solar"),
        ("nav", "vae", "solar"),
        ("nav:smoke", "vae:smoke", "solar:smoke"),
    ]
    assert [(p.left.label, p.right.label) for p in single.pairs] == [("vae", "solar")]
    assert [p.problem for p in smoke.pairs] == ["nav:smoke"]
    # Where there is no default solar, what stands in is said; not what was asked for.
    plain, _, stood_in = (" ".join(p.notes) for p in found.pairs)
    assert "there is no solar of the default variant: solar:smoke stands in for it" in stood_in
    assert "stands in" not in plain + " ".join(smoke.pairs[0].notes)
    assert "solar:smoke stands in for it" in found.to_markdown()


def test_without_solar_another_method_that_learns_stands_in(tmp_path):
    with database(tmp_path) as store:
        for method in ("random", "rce", "vae"):
            compute(store, cell(method), [1.0, 0.2])
        found = compare(store)
    assert [(p.left.label, p.right.label) for p in found.pairs] == [
        ("random", "rce"),
        ("vae", "rce"),
    ]
    assert all("there is no solar: rce stands in for it" in p.notes for p in found.pairs)


def test_exports_say_the_same_and_json_is_strict(tmp_path):
    with database(tmp_path) as store:
        for seed in range(4):
            compute(store, cell("solar", seed), [1.0, NEAR[seed]])
            compute(store, cell("vae", seed), [1.0, FAR[seed]], Outcome.DIVERGED, error="no <b>")
        found = compare(store)
    (entry,) = json.loads(found.to_json(), parse_constant=pytest.fail)
    assert entry["verdict"] == "worse"
    assert entry["ratios"][0]["ratio"] == {"low": 1.0, "high": None}
    assert "| worse (p = 0.029) |" in found.to_markdown()
    assert "diverged" in found.to_markdown()
    assert "<b>" not in found.to_markdown()
    assert r"worse (p = 0.029) \\" in found.to_latex()


def test_a_single_seed_has_no_std_in_json(tmp_path):
    with database(tmp_path) as store:
        compute(store, cell("solar"), [1.0, 0.1])
        for seed in range(2):
            compute(store, cell("vae", seed), [1.0, 0.2])
        (entry,) = json.loads(compare(store).to_json(), parse_constant=pytest.fail)
    assert (entry["left"]["std"], entry["right"]["std"]) == (0.0, None)


def test_named_tasks_alone_are_compared(tmp_path):
    def of(task, method):
        return cells(load_card(task), method, [0])[0]

    with database(tmp_path) as store:
        for method in ("solar", "vae"):
            compute(store, cell(method), [1.0, 0.1])
            compute(store, of("nav-fixed", method), [1.0, 0.1])
        compute(store, of("car", "solar"), [4.0, 0.1])
        assert [pair.problem for pair in compare(store).pairs] == ["nav", "nav-fixed"]
        for tasks, left in ((["nav"], "vae"), (["nav", "car"], None)):
            assert [pair.problem for pair in compare(store, left, tasks=tasks).pairs] == ["nav"]
        with pytest.raises(SolarError, match="no problem of task 'car' has curves of both 'vae'"):
            compare(store, "vae", tasks=["car"])


def test_names_that_nothing_is_stored_of_are_refused_with_the_nearest(tmp_path):
    with database(tmp_path) as store:
        compute(store, cell("solar"), [1.0, 0.1])
        compute(store, cell("vae"), [1.0, 0.1])
        with pytest.raises(UsageError, match=r"'vea'.*'vae'"):
            compare(store, "vea", "solar")
        with pytest.raises(UsageError, match="the same"):
            compare(store, "solar", "solar:default")


def test_one_method_alone_has_nothing_to_be_compared_with(tmp_path):
    with database(tmp_path) as store:
        compute(store, cell("solar"), [1.0, 0.1])
        with pytest.raises(SolarError, match="nothing to compare"):
            compare(store)
