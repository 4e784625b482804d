"""Vitals: each seed's newest value, and nothing that is not finite is hidden."""

import numpy as np
from hand_made import cell, compute, database

from solar_cli.reporting.curves import problems
from solar_cli.reporting.health import chart, spark


def test_vitals_are_the_newest_values_over_seeds(tmp_path):
    with database(tmp_path) as store:
        compute(store, cell(seed=0), [1.0, 0.5, 0.4], train={"cost_r2": [0.1, 0.5]})
        compute(store, cell(seed=1), [1.0, 0.5], train={"cost_r2": [1.0], "kl": [np.nan]})
        compute(store, cell("vae"), [1.0, 0.5], train={"elbo": [-3.0]})
        (problem,) = problems(store)
        shown = chart(store, problem.curves)
    assert shown.labels == ("solar", "vae")
    rows = dict(shown.rows)
    assert list(rows) == ["cost r2", "elbo", "kl"]
    assert str(rows["cost r2"][0]) == "0.75 (0.5 to 1)"
    assert rows["cost r2"][1] is None
    assert str(rows["elbo"][1]) == "-3"
    assert "nan" in str(rows["kl"][0])


def test_a_spark_runs_through_the_finite_values_in_its_box():
    points = spark([1, 2, 3, 5], np.array([0.0, np.nan, 5.0, 10.0]))
    assert points == "0.0,20.0 50.0,10.0 100.0,0.0"
    assert spark([1, 2], np.array([3.0, 3.0])) == "0.0,10.0 100.0,10.0"
    assert spark([1], np.array([3.0])) == ""


def test_a_representation_that_its_method_calls_unhealthy_is_warned_of(tmp_path):
    with database(tmp_path) as store:
        compute(store, cell(seed=0), [1.0, 0.5], train={"alive": [1.0]})
        compute(store, cell(seed=1), [1.0, 0.5], train={"alive": [0.0]})
        compute(store, cell("vae"), [1.0, 0.5], train={"alive": [1.0]})
        (problem,) = problems(store)
        shown = chart(store, problem.curves)
    assert shown.warnings == ["solar: the representation of at least one seed is not healthy"]


def test_the_headline_of_noisy_episodes_is_told_from_the_headline(tmp_path):
    with database(tmp_path) as store:
        train = {"final_distance": [0.7], "kl": [1.0]}
        compute(store, cell(seed=0), [1.0, 0.5], train=train)
        (problem,) = problems(store)
        shown = chart(store, problem.curves)
    assert list(dict(shown.rows)) == ["final distance (train)", "kl"]
