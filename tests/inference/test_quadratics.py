"""Weights of monomials against the quadratics that they are of, in NumPy."""

import numpy as np
import pytest
import torch

from solar_cli.inference import quadratics

K, N = 3, 7


def sampled(m):
    rng = np.random.default_rng(m)
    C = rng.normal(size=(K, m, m))
    rest = rng.normal(size=(K, m + 1))
    return C + C.swapaxes(-1, -2), rest, rng.normal(size=(K, N, m))


@pytest.mark.parametrize("m", [1, 2, 5])
def test_a_quadratic_is_linear_in_monomials(m):
    C, rest, z = sampled(m)
    w = quadratics.weights(torch.as_tensor(C), torch.as_tensor(rest))
    x = quadratics.monomials(torch.as_tensor(z))
    expected = 0.5 * np.einsum("kni,kij,knj->kn", z, C, z)
    expected += np.einsum("kni,ki->kn", z, rest[:, :-1]) + rest[:, -1:]
    np.testing.assert_allclose(np.einsum("knq,kq->kn", x, w), expected, rtol=1e-12)
    np.testing.assert_allclose(quadratics.curvature(w), C, rtol=1e-15)
    assert quadratics.features(w.shape[-1]) == m


@pytest.mark.parametrize("m", [1, 2, 5])
def test_sums_of_monomials_hold_those_of_products(m):
    z = sampled(m)[2]
    sums = quadratics.monomials(torch.as_tensor(z)).sum(dim=1)
    np.testing.assert_allclose(quadratics.outer(sums), z.swapaxes(-1, -2) @ z, rtol=1e-12)
    np.testing.assert_allclose(sums[:, -m - 1 : -1], z.sum(axis=1), rtol=1e-12)
    assert sums[:, -1].tolist() == [N] * K


@pytest.mark.parametrize("m", [1, 2, 5])
def test_squares_of_weights_add_up_to_those_of_coefficients(m):
    C, rest, _ = sampled(m)
    w = quadratics.weights(torch.as_tensor(C), torch.as_tensor(rest)).numpy()
    found = (quadratics.squares(w.shape[-1]).numpy() * np.square(w)).sum(axis=-1)
    expected = 0.5 * np.square(C).sum(axis=(1, 2)) + np.square(rest[:, :-1]).sum(axis=-1)
    np.testing.assert_allclose(found, expected, rtol=1e-12)


@pytest.mark.parametrize("m", [1, 2, 5])
def test_a_quadratic_of_other_coordinates_has_the_same_values(m):
    C, rest, u = sampled(m)
    rng = np.random.default_rng(9)
    A, s = rng.normal(size=(K, m, m)), rng.normal(size=(K, m))
    w = quadratics.weights(torch.as_tensor(C), torch.as_tensor(rest))
    z = u @ A.swapaxes(-1, -2) + s[:, None]
    there = quadratics.substituted(w, torch.as_tensor(A), torch.as_tensor(s))
    values = (
        np.einsum("knq,kq->kn", quadratics.monomials(torch.as_tensor(x)), weights)
        for x, weights in ((z, w), (u, there))
    )
    np.testing.assert_allclose(*values, rtol=1e-9)
