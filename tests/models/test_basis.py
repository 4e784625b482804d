"""The basis of control's states: whitened, scaled, and exact about what shifting does."""

import numpy as np
import pytest
import torch

from solar_cli.inference import mniw
from solar_cli.models.basis import LEAST_SHARE, LatentBasis

windows_and_latents = pytest.mark.parametrize(("window", "d"), [(1, 3), (2, 2), (4, 2), (3, 1)])


def walk(window, d, n=400, seed=0):
    """Windows, newest first, along correlated walks of very different scales around an offset."""
    rng = np.random.default_rng(seed)
    mixing = rng.normal(size=(d, d)) + 2 * np.eye(d)
    start = rng.normal(size=(n, 1, d)) * 10.0 ** rng.uniform(-2, 2, d)
    steps = 0.01 * rng.normal(size=(n, window, d))
    y = (start + np.cumsum(steps, axis=1)) @ mixing.T + 7.0
    return torch.as_tensor(y[:, ::-1].copy())


@windows_and_latents
def test_newest_latents_are_white(window, d):
    w = walk(window, d)
    u = LatentBasis.whitening(w).state(w)[:, :d].numpy()
    # Unit variance up to the floor, which is 1e-4 of the largest eigenvalue.
    np.testing.assert_allclose(u.mean(axis=0), 0, atol=1e-9)
    covariance = np.cov(u.T).reshape(d, d)
    spectrum = np.linalg.eigvalsh(np.cov(w[:, 0].numpy().T).reshape(d, d))
    share = np.minimum(spectrum / (LEAST_SHARE * spectrum[-1]), 1.0)
    np.testing.assert_allclose(covariance, np.diag(share), atol=1e-9)


def test_latents_of_one_scale_have_unit_covariance():
    rng = np.random.default_rng(1)
    w = torch.as_tensor(rng.normal(size=(300, 1, 4)) @ rng.normal(size=(4, 4)) + 3.0)
    u = LatentBasis.whitening(w).state(w).numpy()
    np.testing.assert_allclose(np.cov(u.T), np.eye(4), atol=1e-9)


def test_differences_have_unit_std_and_keep_their_zero():
    w = walk(4, 2)
    basis = LatentBasis.whitening(w)
    z = basis.state(w)
    for block in range(1, 4):
        np.testing.assert_allclose(z[:, 2 * block : 2 * block + 2].std(dim=0), 1.0, rtol=1e-9)
    # Nothing moves in a window of equal frames, wherever it is.
    still = basis.state(w[:, :1].expand(-1, 4, -1))
    np.testing.assert_allclose(still[:, 2:], 0, atol=1e-9)


def test_a_block_is_a_difference_of_neighbours():
    w = walk(3, 2)
    basis = LatentBasis.whitening(w)
    moved = w.clone()
    moved[:, 2] += 1.0  # the oldest frame
    change = (basis.state(moved) - basis.state(w)).abs()
    assert float(change[:, :4].max()) < 1e-9
    assert float(change[:, 4:].min()) > 1e-3


@pytest.mark.parametrize("window", [1, 3])
def test_a_latent_that_never_changes_breaks_nothing(window):
    w = walk(window, 3)
    w[..., 1] = 4.0
    basis = LatentBasis.whitening(w)
    z = basis.state(w)
    assert bool(torch.isfinite(z).all())
    np.testing.assert_allclose(torch.linalg.inv(basis.A) @ basis.A, np.eye(3 * window), atol=1e-6)
    assert float(z.std(dim=0).max()) < 1.01


@windows_and_latents
def test_the_successor_is_that_of_the_shifted_window(window, d):
    frames = walk(window + 1, d)  # newest first: the window after, and the one before
    after, before = frames[:, :-1], frames[:, 1:]
    basis = LatentBasis.whitening(before)
    P, G, h = basis.successor(d)
    newest = basis.state(after)[:, :d]
    found = basis.state(before) @ P.T + newest @ G.T + h
    torch.testing.assert_close(found, basis.state(after), rtol=1e-8, atol=1e-8)
    torch.testing.assert_close(G[:d], torch.eye(d).double(), rtol=0, atol=1e-8)
    torch.testing.assert_close(P[:d], torch.zeros(d, window * d).double(), rtol=0, atol=1e-8)


@windows_and_latents
def test_statistics_change_variables_as_the_data_do(window, d):
    rng = np.random.default_rng(2)
    frames = walk(window + 1, d)
    after, before = frames[:, :-1], frames[:, 1:]
    basis = LatentBasis.whitening(before)
    actions = torch.as_tensor(rng.normal(size=(len(frames), 2)))
    one = torch.ones(len(frames), 1).double()
    latents = torch.cat([after[:, 0], before.flatten(1), actions, one], dim=1)
    z, u = basis.state(before), basis.state(after)[:, :d]
    states = torch.cat([u - z[:, :d], z, actions, one], dim=1)
    R = basis.change_of_variables(d, 2)
    torch.testing.assert_close(latents @ R.T, states, rtol=1e-8, atol=1e-8)
    sums = latents.T @ latents
    found = R @ sums @ R.T
    # The offset of the latents cancels in differences: digits are relative to what is summed.
    rounding = 1e-13 * (R.abs() @ sums.abs() @ R.abs().T)
    assert bool(((found - states.T @ states).abs() <= rounding).all())
    statistics = mniw.regression_statistics(states[:, d:], states[:, :d])
    assert bool(((found[:d, d:] - statistics.yx).abs() <= rounding[:d, d:]).all())
