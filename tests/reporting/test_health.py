"""Vitals: each seed's newest value, and nothing that is not finite is hidden."""

import numpy as np
import pytest
from hand_made import cell, compute, database

from solar_cli.reporting.curves import problems
from solar_cli.reporting.health import chart, spark
from solar_cli.reporting.signs import signs


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
    assert shown.warnings == ["solar: in at least one seed the representation is not healthy"]


@pytest.mark.parametrize(
    ("metric", "healthy", "bad", "says"),
    [
        ("alive", 1.0, 0.0, "representation is not healthy"),
        ("action_seen_late", 0.0, 1.0, "an earlier action but not the last one"),
        ("stuck", 0.0, 1.0, "come to rest where they cost more"),
        ("clipped", 0.5, 0.51, "at the card's bound"),
    ],
)
def test_a_sign_is_told_by_the_newest_value_of_any_seed(tmp_path, metric, healthy, bad, says):
    with database(tmp_path) as store:
        every = [cell(seed=0), cell(seed=1), cell("vae")]
        for one, values in zip(every, ([healthy], [healthy, bad], [bad, healthy]), strict=True):
            compute(store, one, [1.0, 0.5, 0.4], train={metric: values, "kl": [1.0, 1.0]})
        (problem,) = problems(store)
        (warning,) = chart(store, problem.curves).warnings
        assert warning.startswith("solar: in at least one seed ")
        assert says in warning
        (sign,) = signs(store, every[1].hash)
        assert warning.endswith(sign)
        assert signs(store, every[0].hash) == signs(store, every[2].hash) == []
        compute(store, cell(seed=2), [1.0, 0.5], train={metric: [np.nan]})
        assert signs(store, cell(seed=2).hash) == [sign]  # what is no number is not healthy


def test_the_headline_of_noisy_episodes_is_told_from_the_headline(tmp_path):
    with database(tmp_path) as store:
        train = {"final_distance": [0.7], "kl": [1.0]}
        compute(store, cell(seed=0), [1.0, 0.5], train=train)
        (problem,) = problems(store)
        shown = chart(store, problem.curves)
    assert list(dict(shown.rows)) == ["final distance (train)", "kl"]
