"""What a judge is told of latents: linear maps both ways between them and the truth."""

import numpy as np
import pytest

from solar_cli.models.diagnostics import latent_metrics, linear_r2

rng = np.random.default_rng(0)
TRUTH = rng.normal(size=(400, 3)) * [1.0, 1e3, 1e-3] + [5.0, -1.0, 0.0]
NAMES = ("x", "y", "z")


def test_an_affine_map_explains_all_both_ways():
    latents = TRUTH @ rng.normal(size=(3, 3)) + 7.0
    found = latent_metrics(latents, TRUTH, NAMES)
    names = [f"truth_r2_{name}" for name in NAMES] + [f"latent_r2_{i}" for i in range(3)]
    assert list(found) == names
    assert min(found.values()) > 1 - 1e-6


def test_noise_is_explained_by_chance_alone():
    found = linear_r2(rng.normal(size=(400, 3)), TRUTH)
    # Three regressors of 400 samples explain 3 / 400 on average.
    assert (np.abs(found - 3 / 400) < 5 * np.sqrt(6) / 400).all()


def test_a_share_is_that_of_the_variance():
    x, noise = rng.normal(size=(2, 200_000))
    found = linear_r2(x[:, None], np.stack([x + noise, x + 3 * noise], axis=1))
    np.testing.assert_allclose(found, [1 / 2, 1 / 10], atol=0.01)


def test_a_column_that_does_not_vary_has_nothing_to_explain():
    still = np.column_stack([TRUTH[:, 0], np.full(400, 3.0)])
    assert linear_r2(still, still).tolist() == pytest.approx([1.0, 1.0])
