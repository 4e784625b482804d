"""Observation models against SciPy, cross entropies by hand, and numbers on paper."""

import math

import numpy as np
import pytest
import torch
from scipy import optimize, special, stats

from solar_cli.models.likelihoods import (
    UNCALIBRATED,
    bernoulli,
    calibrated,
    categorical,
    explained_variance,
    gaussian,
    mean_frame,
    pyramid_error,
)


def draws(*shape, seed=0):
    return torch.as_tensor(np.random.default_rng(seed).normal(size=shape))


def shares(*shape, seed=1):
    return torch.as_tensor(np.random.default_rng(seed).uniform(size=shape))


def test_categorical_is_the_cross_entropy_of_every_channels_ink():
    outputs, frames = draws(3, 2, 4, 5), shares(3, 2, 4, 5)
    ink = frames.numpy().reshape(6, 20)
    log_share = special.log_softmax(outputs.numpy().reshape(6, 20), axis=1)
    by_hand = -(ink / ink.sum(axis=1, keepdims=True) * log_share).sum() / 3
    assert float(categorical(outputs, frames)) == pytest.approx(by_hand, rel=1e-12)
    # torch's own, which takes class probabilities.
    target = frames.flatten(2).flatten(0, 1)
    target = target / target.sum(dim=1, keepdim=True)
    entropy = torch.nn.functional.cross_entropy(
        outputs.flatten(2).flatten(0, 1), target, reduction="sum"
    )
    assert float(categorical(outputs, frames)) == pytest.approx(float(entropy) / 3, rel=1e-12)


def test_the_least_categorical_loss_is_the_entropy_of_the_frame():
    frames = shares(2, 1, 3, 3)
    entropy = np.mean([stats.entropy(frame.flatten().numpy()) for frame in frames])
    assert float(categorical(frames.log(), frames)) == pytest.approx(entropy, rel=1e-12)


def test_categorical_does_not_depend_on_how_much_ink_there_is():
    outputs, frames = draws(3, 2, 4, 5), shares(3, 2, 4, 5)
    scaled = frames * torch.tensor([3.0, 20.0]).view(1, 2, 1, 1)
    assert float(categorical(outputs, scaled)) == pytest.approx(float(categorical(outputs, frames)))


def test_a_blank_channel_says_nothing():
    outputs, frames = draws(1, 2, 4, 5), shares(1, 2, 4, 5)
    frames[:, 1] = 0.0
    alone = categorical(outputs[:, :1], frames[:, :1])
    assert float(categorical(outputs, frames)) == pytest.approx(float(alone), rel=1e-12)


def test_bernoulli_is_the_log_likelihood_of_every_pixel():
    outputs = draws(3, 2, 4, 5)
    coins = (shares(3, 2, 4, 5) > 0.5).double()
    by_scipy = -stats.bernoulli(special.expit(outputs.numpy())).logpmf(coins.numpy()).sum() / 3
    assert float(bernoulli(outputs, coins)) == pytest.approx(by_scipy, rel=1e-12)


def test_bernoulli_of_grey_pixels_is_their_cross_entropy():
    outputs, grey = draws(3, 7), shares(3, 7)
    share = special.expit(outputs.numpy())
    by_hand = -(grey.numpy() * np.log(share) + (1 - grey.numpy()) * np.log(1 - share)).sum() / 3
    assert float(bernoulli(outputs, grey)) == pytest.approx(by_hand, rel=1e-12)


def test_gaussian_has_unit_variance():
    outputs, frames = draws(3, 2, 4, 5), draws(3, 2, 4, 5, seed=2)
    density = stats.norm(outputs.numpy()).logpdf(frames.numpy()).sum() / 3
    up_to_constant = -density - 20 * math.log(2 * math.pi)
    assert float(gaussian(outputs, frames)) == pytest.approx(up_to_constant, rel=1e-12)


def test_calibrated_is_half_the_dimensions_times_the_log_error():
    outputs, frames = draws(3, 2, 4, 5), draws(3, 2, 4, 5, seed=2)
    error = np.square(outputs.numpy() - frames.numpy()).mean()
    found = calibrated(outputs, frames, 20.0, pyramid=False)
    assert float(found) == pytest.approx(20.0 * math.log(error), rel=1e-12)


def test_calibrated_is_a_gaussian_of_the_best_common_scale():
    outputs = draws(3, 7)

    def least(frames):
        """The least negative log-likelihood a frame over scales, found by search."""

        def loss(log_scale):
            scale = math.exp(log_scale)
            return -stats.norm(outputs.numpy(), scale).logpdf(frames.numpy()).sum() / 3

        return optimize.minimize_scalar(loss, bounds=(-9, 9), options={"xatol": 1e-9}).fun

    near, far = outputs + 0.1 * draws(3, 7, seed=3), outputs + 2.0 * draws(3, 7, seed=4)
    difference = calibrated(outputs, far, 7 / 2, False) - calibrated(outputs, near, 7 / 2, False)
    assert float(difference) == pytest.approx(least(far) - least(near), rel=1e-6)


def pooled(residual, side):
    """Mean square of whole blocks' means; a remainder at the border is left out."""
    rows, columns = (size // side for size in residual.shape[-2:])
    means = [
        residual[:, :, r * side : (r + 1) * side, k * side : (k + 1) * side].mean(axis=(2, 3))
        for r in range(rows)
        for k in range(columns)
    ]
    return np.square(means).mean()


@pytest.mark.parametrize(
    ("shape", "sides"), [((8, 12), (4, 8)), ((6, 9), (4,)), ((3, 30), ()), ((16, 16), (4, 8))]
)
def test_errors_are_those_of_the_frame_and_of_its_pooled_versions(shape, sides):
    residual = draws(3, 2, *shape)
    expected = np.square(residual.numpy()).mean()
    for side in sides:
        expected += {4: 16.0, 8: 64.0}[side] * pooled(residual.numpy(), side)
    assert float(pyramid_error(residual)) == pytest.approx(expected, rel=1e-12)
    loss = calibrated(residual, torch.zeros_like(residual), 2.0, pyramid=True)
    assert float(loss) == pytest.approx(2.0 * math.log(expected), rel=1e-12)


def test_states_have_no_pyramid():
    residual = draws(5, 16)
    assert float(pyramid_error(residual)) == pytest.approx(float(residual.square().mean()))


def test_independent_errors_weigh_the_same_at_every_side_of_the_pyramid():
    # The mean of n independent errors has variance 1/n, and the weights are 16 and 64 = n.
    white = draws(400, 1, 16, 16)
    assert float(pyramid_error(white)) == pytest.approx(3.0, abs=0.1)  # 5 standard errors


def test_expected_frames():
    outputs, frames = draws(3, 2, 4, 5), shares(3, 2, 4, 5)
    for likelihood in ("calibrated", "gaussian"):
        torch.testing.assert_close(mean_frame(outputs, frames, likelihood), outputs)
    found = mean_frame(outputs, frames, "bernoulli").numpy()
    np.testing.assert_allclose(found, special.expit(outputs.numpy()), rtol=1e-12)
    found = mean_frame(outputs, frames, "categorical").numpy()
    ink = frames.numpy().sum(axis=(2, 3), keepdims=True)
    share = special.softmax(outputs.numpy().reshape(3, 2, 20), axis=2).reshape(3, 2, 4, 5)
    np.testing.assert_allclose(found, ink * share, rtol=1e-12)


@pytest.mark.parametrize("likelihood", sorted(UNCALIBRATED))
def test_the_expected_frame_has_the_least_loss(likelihood):
    """For outputs that say the frame exactly, the gradient vanishes."""
    frames = shares(3, 2, 4, 5)
    inverse = {"gaussian": lambda f: f, "bernoulli": torch.logit, "categorical": torch.log}
    outputs = inverse[likelihood](frames).requires_grad_()
    torch.testing.assert_close(mean_frame(outputs, frames, likelihood), frames)
    [gradient] = torch.autograd.grad(UNCALIBRATED[likelihood](outputs, frames), outputs)
    assert float(gradient.abs().max()) < 1e-12


def test_explained_variance_by_hand():
    # Entry 0 varies by 1 around 2 and is missed by 0.5, entry 1 never changes, entry 2 is perfect.
    frames = torch.tensor([[1.0, 5.0, 0.0], [3.0, 5.0, 4.0]])
    expected = torch.tensor([[1.5, 7.0, 0.0], [3.5, 5.0, 4.0]])
    torch.testing.assert_close(explained_variance(expected, frames), torch.tensor([0.75, 1.0, 1.0]))


def test_the_mean_frame_explains_nothing():
    frames = shares(6, 3, 4, 5)
    found = explained_variance(frames.mean(dim=0).expand_as(frames), frames)
    torch.testing.assert_close(found, torch.zeros(3, dtype=torch.float64), rtol=0, atol=1e-12)


def test_explained_variance_is_pooled_over_the_pixels_of_a_channel():
    frames, expected = shares(6, 2, 4, 5), shares(6, 2, 4, 5, seed=3)
    for channel, found in enumerate(explained_variance(expected, frames)):
        residual, spread = 0.0, 0.0
        for pixel in np.ndindex(4, 5):
            values = frames[:, channel, *pixel].numpy()
            residual += np.square(values - expected[:, channel, *pixel].numpy()).sum()
            spread += values.var() * 6
        assert float(found) == pytest.approx(1 - residual / spread, rel=1e-12)
