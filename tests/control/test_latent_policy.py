"""A policy on windows of latents: its noise, its windows, and what it encodes."""

import numpy as np
import pytest
import torch

from solar_cli.control.exploration import smooth_noise
from solar_cli.control.latent_policy import LatentPolicy
from solar_cli.control.linear_gaussian import LinearGaussianPolicy
from solar_cli.episodes import window_indices
from solar_cli.models.basis import LatentBasis

N, T, W, d, a = 3, 6, 3, 2, 2


class Embedding:
    """A latent is the first two entries of a frame; every encoded frame is counted."""

    def __init__(self, window=W, trained=True) -> None:
        rng = np.random.default_rng(0)
        size = window * d
        self.trained = trained
        self.basis = LatentBasis(
            torch.as_tensor(rng.normal(size=(size, size))), torch.as_tensor(rng.normal(size=size))
        )
        self.encoded: list[np.ndarray] = []
        self.carried: list[tuple] = []

    def follow(self, frames, t, belief, actions):
        self.encoded.append(frames.copy())
        self.carried.append((t, belief, actions))
        return torch.from_numpy(frames[:, :d].astype(np.float64)), t


def gains(window=W, seed=1) -> LinearGaussianPolicy:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(T, a, a))
    return LinearGaussianPolicy(
        torch.as_tensor(rng.normal(size=(T, a, window * d))),
        torch.as_tensor(rng.normal(size=(T, a))),
        torch.as_tensor(root @ root.swapaxes(1, 2) + 0.1 * np.eye(a)),
    )


def run(policy: LatentPolicy, frames: np.ndarray, stream=None):
    """Actions and means (N, T, a) on recorded frames (N, T+1, S)."""
    state = policy.start(len(frames), stream)
    actions, means = [], []
    index = window_indices(T, policy.window)
    for t in range(T):
        action, mean, state = policy.act(frames[:, index[t]], t, state)
        actions.append(action)
        means.append(mean)
    return np.stack(actions, axis=1), np.stack(means, axis=1)


def frames(seed=2) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(N, T + 1, 4))


# Noise


@pytest.mark.parametrize("smoothing", [0.0, 0.5, 2.0, 5.0])
def test_noise_has_unit_variance_at_every_step(smoothing):
    noise = smooth_noise((4000, 12, 2), smoothing, np.random.default_rng(0))
    assert noise.shape == (4000, 12, 2)
    # A variance of 4000 draws has a standard error of sqrt(2 / 4000).
    np.testing.assert_allclose(noise.var(axis=0), 1.0, atol=5 * np.sqrt(2 / 4000))
    np.testing.assert_allclose(noise.mean(axis=0), 0.0, atol=5 / np.sqrt(4000))


@pytest.mark.parametrize("smoothing", [1.0, 2.0])
def test_smooth_noise_is_correlated_as_a_smoothed_white_one(smoothing):
    noise = smooth_noise((5_000, 8, 1), smoothing, np.random.default_rng(0))[..., 0]
    found = np.corrcoef(noise.T)
    lag = np.abs(np.subtract.outer(np.arange(8), np.arange(8)))
    # A Gaussian with itself is a Gaussian of sqrt 2 its width; sampling at whole steps and cutting
    # it at four widths changes that by less than the errors of the draws.
    expected = np.exp(-((lag / smoothing) ** 2) / 4)
    np.testing.assert_allclose(found, expected, atol=5 / np.sqrt(5_000))


def test_white_noise_is_white_and_entries_are_independent():
    noise = smooth_noise((5_000, 3, 2), 0.0, np.random.default_rng(0)).reshape(5_000, 6)
    np.testing.assert_allclose(np.corrcoef(noise.T), np.eye(6), atol=5 / np.sqrt(5_000))


@pytest.mark.parametrize("smoothing", [0.0, 2.0])
def test_a_policys_noise_has_the_covariance_of_its_time_step(smoothing):
    policy = LatentPolicy(gains(), Embedding(trained=False), W, smoothing)
    count = 5_000
    still = np.zeros((count, T + 1, 4))
    actions, means = run(policy, still, np.random.default_rng(0))
    for t in range(T):
        S = policy.gains.S[t].numpy()
        found = np.cov((actions - means)[:, t].T)
        error = np.sqrt((np.outer(np.diag(S), np.diag(S)) + S**2) / count)
        assert bool((np.abs(found - S) < 5 * error).all()), t


def test_without_a_stream_the_policy_acts_on_its_mean():
    policy = LatentPolicy(gains(), Embedding(), W, 2.0)
    actions, means = run(policy, frames())
    np.testing.assert_array_equal(actions, means)


def test_means_are_without_noise_and_are_no_view_of_the_actions():
    policy = LatentPolicy(gains(), Embedding(), W, 0.0)
    _, quiet = run(policy, frames())
    actions, means = run(policy, frames(), np.random.default_rng(0))
    np.testing.assert_array_equal(means, quiet)
    assert not np.isclose(actions, means).any()
    action, mean, _ = policy.act(frames()[:, [0] * W], 0, policy.start(N, None))
    action += 1.0
    np.testing.assert_array_equal(mean, quiet[:, 0])
    np.testing.assert_array_equal(policy.gains.k, gains().k)


def test_the_same_stream_gives_the_same_noise():
    policy = LatentPolicy(gains(), Embedding(), W, 2.0)
    first, second = (run(policy, frames(), np.random.default_rng(5))[0] for _ in range(2))
    np.testing.assert_array_equal(first, second)


# Windows


@pytest.mark.parametrize("window", [1, 2, 3, 5])
def test_means_are_linear_in_the_state_of_the_window(window):
    embedding = Embedding(window)
    policy = LatentPolicy(gains(window), embedding, window, 0.0)
    seen = frames()
    _, means = run(policy, seen)
    A, b = (part.numpy() for part in embedding.basis)
    for n in range(N):
        for t in range(T):
            # Newest first; before the start the first frame repeats.
            w = np.concatenate([seen[n, max(t - back, 0), :d] for back in range(window)])
            expected = policy.gains.K[t].numpy() @ (A @ w + b) + policy.gains.k[t].numpy()
            np.testing.assert_allclose(means[n, t], expected, rtol=1e-10, atol=1e-10)


def test_only_the_newest_frame_is_encoded_at_each_step():
    embedding = Embedding()
    seen = frames()
    run(LatentPolicy(gains(), embedding, W, 0.0), seen)
    assert len(embedding.encoded) == T
    for t, encoded in enumerate(embedding.encoded):
        np.testing.assert_array_equal(encoded, seen[:, t])


def test_an_embedding_is_handed_its_belief_and_what_was_done_since():
    embedding = Embedding()
    policy = LatentPolicy(gains(), embedding, W, 0.0)
    actions, _ = run(policy, frames(), np.random.default_rng(0))
    for t, (step, belief, done) in enumerate(embedding.carried):
        assert step == t
        assert belief == (t - 1 if t else None)  # it returns the time step
        if t:
            np.testing.assert_array_equal(done, actions[:, t - 1])
        else:
            assert done is None


def test_an_untrained_embedding_is_never_asked():
    embedding = Embedding(trained=False)
    policy = LatentPolicy(gains(), embedding, W, 0.0)
    _, means = run(policy, frames())
    assert not embedding.encoded
    np.testing.assert_array_equal(means, np.tile(policy.gains.k.numpy(), (N, 1, 1)))


def test_episodes_do_not_know_of_each_other():
    policy = LatentPolicy(gains(), Embedding(), W, 0.0)
    seen = frames()
    _, together = run(policy, seen)
    for n in range(N):
        _, alone = run(policy, seen[n : n + 1])
        np.testing.assert_allclose(alone[0], together[n], rtol=1e-12)
    _, again = run(policy, seen)  # nothing is left over from the episodes before
    np.testing.assert_array_equal(again, together)
