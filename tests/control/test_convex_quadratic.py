"""The best convex quadratic, by its conditions of optimality and by another way to it."""

import numpy as np
import pytest
import torch
from scipy.optimize import minimize

from solar_cli.control.convex_quadratic import Moments, descended, least_squares
from solar_cli.inference.quadratics import curvature, squares

ROUNDS = 300
"""enough to converge"""


def costs(kind, z, rng):
    x, y, noise = z[..., 0], z[..., 1], 0.1 * rng.normal(size=z.shape[:-1])
    return {
        "saddle": x * y,
        "concave": -x * x - y,
        "bowl": x * x + 0.5 * y * y - x + 0.2 * np.square(z[..., 2:]).sum(axis=-1) + noise,
        "half a saddle": x * x - 0.3 * y * y + noise,
        "wave": np.cos(2 * x + y) + np.abs(y),
    }[kind]


KINDS = ("saddle", "concave", "bowl", "half a saddle", "wave")


def sampled(kind, m=3, seed=0, episodes=50, horizon=4):
    rng = np.random.default_rng(seed)
    z = rng.normal(size=(episodes, horizon, m)) + 0.3
    y = costs(kind, z, rng)
    live = torch.ones(episodes, horizon, dtype=torch.bool)
    return z, y, Moments.of(torch.as_tensor(z), torch.as_tensor(y), live)


def fitted(moments, rounds=ROUNDS):
    mean = moments.together().mean()
    penalty = 1e-3 * squares(mean.xy.shape[-1]).double()
    return mean, penalty, least_squares(mean, penalty, torch.zeros_like(mean.xy), rounds)


def objective(mean, penalty, w):
    return float(mean.error(w) + (penalty * w.square()).sum())


def by_cholesky(z, y, ridge):
    """The least objective over C = L L^T, from many starts, on the samples themselves."""
    m = z.shape[-1]
    z, y = z.reshape(-1, m), y.ravel()
    i, j = np.tril_indices(m)

    def loss(parameters):
        L = np.zeros((m, m))
        L[i, j] = parameters[: len(i)]
        C, (*c, b) = L @ L.T, parameters[len(i) :]
        wrong = 0.5 * np.einsum("ni,ij,nj->n", z, C, z) + z @ c + b - y
        return np.square(wrong).mean() + ridge * (np.square(C).sum() / 2 + np.square(c).sum())

    rng = np.random.default_rng(0)
    starts = rng.normal(size=(8, len(i) + m + 1))
    return min(minimize(loss, start, method="BFGS", tol=1e-9).fun for start in starts)


@pytest.mark.parametrize("kind", KINDS)
def test_no_other_convex_quadratic_is_better(kind):
    z, y, moments = sampled(kind)
    best = by_cholesky(z, y, 1e-3)
    assert objective(*fitted(moments)) == pytest.approx(best, rel=2e-4, abs=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_it_meets_the_conditions_of_optimality(kind):
    """At the best C >= 0 the gradient G is >= 0 too, and <G, C> = 0: no way down is left."""
    m, (_, _, moments) = 4, sampled(kind, m=4, seed=1)
    mean, penalty, w = fitted(moments)
    w.requires_grad_()
    (mean.error(w) + (penalty * w.square()).sum()).backward()
    slope, second = w.grad, m * (m + 1) // 2
    i, j = torch.tril_indices(m, m)
    G = torch.zeros(m, m).double()
    G[i, j] = G[j, i] = slope[:second] / 2  # <G, dC> = slope^T dw
    C = curvature(w.detach())
    assert float(torch.linalg.eigvalsh(C).min()) > -1e-12
    assert float(torch.linalg.eigvalsh(G).min()) > -1e-4
    assert float((G * C).sum()) == pytest.approx(0, abs=1e-4)
    np.testing.assert_allclose(slope[second:], 0, atol=1e-9)


@pytest.mark.parametrize("scale", [0.1, 10.0])
@pytest.mark.parametrize("kind", KINDS)
def test_units_of_states_do_not_matter(kind, scale):
    """But for the ridge, whose units are those of coefficients."""
    z, y, moments = sampled(kind)
    live = torch.ones(y.shape, dtype=torch.bool)
    scaled = Moments.of(scale * torch.as_tensor(z), torch.as_tensor(y), live).together().mean()
    none = torch.full_like(scaled.xy, 1e-12)
    errors = [
        float(mean.error(least_squares(mean, none, torch.zeros_like(mean.xy), ROUNDS)))
        for mean in (moments.together().mean(), scaled)
    ]
    assert errors[1] == pytest.approx(errors[0], rel=0.02, abs=1e-6)


def test_moments_that_are_no_numbers_are_refused():
    _, _, moments = sampled("bowl")
    with pytest.raises(torch.linalg.LinAlgError):
        fitted(moments.each(lambda part: part * torch.nan))


@pytest.mark.parametrize("kind", KINDS)
def test_thirty_rounds_are_nearly_there(kind):
    _, _, moments = sampled(kind, m=5, seed=2)
    cut, few, many = (objective(*fitted(moments, rounds)) for rounds in (0, 30, 1000))
    assert many <= few + 1e-9
    assert few - many <= 0.02 * many + 1e-9
    assert few <= cut + 1e-9


def test_gradients_through_the_cholesky_factor_lead_to_the_same():
    _, _, moments = sampled("bowl")
    mean, penalty, w = fitted(moments)
    other = descended(mean, penalty)
    assert objective(mean, penalty, other) == pytest.approx(objective(mean, penalty, w), rel=0.02)


def test_fits_made_at_once_are_those_made_alone():
    parts = [sampled(kind)[2].together() for kind in KINDS]
    mean = Moments.stacked(parts).mean()
    penalty = (1e-3 * squares(mean.xy.shape[-1]).double()).expand_as(mean.xy)
    together = least_squares(mean, penalty, torch.zeros_like(mean.xy), 30)
    for kind, w in zip(KINDS, together, strict=True):
        alone = fitted(sampled(kind)[2], rounds=30)[2]
        torch.testing.assert_close(w, alone, rtol=1e-9, atol=1e-9)


def test_a_time_step_without_samples_gets_what_it_is_pulled_to():
    _, _, moments = sampled("bowl")
    empty = moments.each(torch.zeros_like).mean()
    towards = fitted(moments)[2].expand_as(empty.xy)
    penalty = torch.full_like(empty.xy, 0.1)
    found = least_squares(empty, penalty, towards, 0)
    torch.testing.assert_close(found, towards, rtol=1e-9, atol=1e-9)
