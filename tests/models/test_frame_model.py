"""Frames as networks see them, and the two networks of a card."""

import math

import numpy as np
import pytest
import torch

from solar_cli.errors import UsageError
from solar_cli.models import frames as frames_module
from solar_cli.models.frames import FrameModel
from solar_cli.settings.local import Representation
from solar_cli.settings.task import Observation

IMAGES = Observation(kind="image", channels=2, height=8, width=6)
STATES = Observation(kind="state", width=4)
ENCODER = ({"kind": "linear", "width": 5},)


def model(observation=IMAGES, **settings) -> FrameModel:
    torch.manual_seed(0)
    table = {"latent": 3, "encoder": ENCODER, "decoder": ENCODER, **settings}
    return FrameModel(Representation.model_validate(table), observation)


def images(count=7, seed=0):
    rng = np.random.default_rng(seed)
    return torch.as_tensor(rng.integers(0, 256, (count, 2, 8, 6)).astype(np.uint8))


def states(count=9, seed=0):
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(count, 4)) * [1.0, 50.0, 1e-3, 0.0] + [0.0, 9.0, 1.0, 3.0]
    return torch.as_tensor(values.astype(np.float32))


def test_standardised_images_have_one_scale_around_the_mean_image():
    networks = model()
    networks.standardise_by(images())
    found = networks.scaled(images())
    pixels = images().double().numpy()
    centred = pixels - pixels.mean(axis=0)
    expected = centred / math.sqrt(np.square(centred).mean())
    np.testing.assert_allclose(found, expected, atol=1e-5)  # float32
    assert float(found.square().mean()) == pytest.approx(1.0, rel=1e-5)


def test_scales_of_many_frames_are_those_of_all_at_once(monkeypatch):
    together, apart = model(), model()
    together.standardise_by(images())
    monkeypatch.setattr(frames_module, "CHUNK", 2)
    apart.standardise_by(images())
    torch.testing.assert_close(apart.frame_mean, together.frame_mean)
    torch.testing.assert_close(apart.frame_scale, together.frame_scale)


def test_standardised_states_have_a_scale_an_entry():
    networks = model(STATES)
    networks.standardise_by(states())
    found = networks.scaled(states())
    values = states().double().numpy()
    centred = values - values.mean(axis=0)
    scaled = centred[:, :3] / centred[:, :3].std(axis=0)
    np.testing.assert_allclose(found[:, :3], scaled, atol=2e-4)  # float32 around 1 +- 0.001
    assert found[:, 3].abs().max() == 0  # a constant entry stays zero


@pytest.mark.parametrize("observation", [IMAGES, STATES])
def test_unit_inputs_are_frames_in_their_own_units(observation):
    networks = model(observation, input="unit")
    frames = images() if observation is IMAGES else states()
    networks.standardise_by(frames)
    unit = 255.0 if observation is IMAGES else 1.0
    torch.testing.assert_close(networks.scaled(frames), frames.float() / unit)


@pytest.mark.parametrize("scaling", ["standardised", "unit"])
def test_scaling_loses_no_frame(scaling):
    networks = model(input=scaling)
    networks.standardise_by(images())
    found = networks.as_frames(networks.scaled(images(seed=1)))
    assert found.dtype == torch.uint8
    assert torch.equal(found, images(seed=1))
    # What a network draws may leave the range of a pixel.
    assert networks.as_frames(torch.full((1, 2, 8, 6), 99.0)).min() == 255
    vectors = model(STATES, input=scaling)
    vectors.standardise_by(states())
    torch.testing.assert_close(vectors.as_frames(vectors.scaled(states())), states())


def test_the_scale_is_part_of_the_state():
    networks, fresh = model(), model()
    networks.standardise_by(images())
    fresh.load_state_dict(networks.state_dict())
    assert torch.equal(fresh.scaled(images(seed=1)), networks.scaled(images(seed=1)))


def test_a_fixed_variance_is_the_cards_number():
    networks = model(variance=1e-4)
    mean, variance = networks.encode(networks.scaled(images()))
    assert mean.shape == variance.shape == (7, 3)
    assert bool((variance == 1e-4).all())
    assert not any("log_variance" in name for name, _ in networks.named_parameters())


def test_a_learned_variance_starts_small_and_stays_in_range():
    networks = model()
    scaled = networks.scaled(images())
    _, variance = networks.encode(scaled)
    torch.testing.assert_close(variance, torch.full((7, 3), math.exp(-4.0)))
    for value in (-1e3, 1e3):
        torch.nn.init.constant_(networks.log_variance[-1].bias, value)
        _, variance = networks.encode(scaled)
        assert bool((variance > 1e-7).all())
        assert bool((variance < 1e2).all())


def test_without_a_head_the_encoders_last_layer_is_the_latent():
    encoder = ({"kind": "spatial_softmax"},)
    networks = model(encoder=encoder, head="none", latent=4)
    scaled = networks.scaled(images())
    torch.testing.assert_close(networks.encode(scaled)[0], networks.body(scaled))
    with pytest.raises(UsageError, match=r"head = 'none'.*3 outputs.*has 4"):
        model(encoder=encoder, head="none", latent=3)


def test_a_categorical_needs_images():
    model(likelihood="categorical", input="unit")
    with pytest.raises(UsageError, match="categorical likelihood needs images"):
        model(STATES, likelihood="categorical", input="unit")


@pytest.mark.parametrize(
    "decoder",
    [
        (),
        ({"kind": "linear", "width": 5},),
        ({"kind": "deconv", "channels": 3, "size": 2}, {"kind": "conv", "channels": 4, "size": 2}),
        ({"kind": "bumps", "points": 3},),
        ({"kind": "deconv", "channels": 5, "size": 8}, {"kind": "conv", "channels": 2, "size": 1}),
    ],
)
def test_every_decoder_ends_in_a_frame(decoder):
    networks = model(decoder=decoder)
    scaled = networks.scaled(images())
    latents = networks.encode(scaled)[0]
    assert networks.decoder(latents).shape == scaled.shape
    assert networks.reconstruct(scaled).shape == scaled.shape
    assert networks.reconstruction_loss(latents, scaled).shape == ()


def test_the_loss_is_that_of_the_cards_likelihood():
    for likelihood in ("calibrated", "gaussian", "bernoulli", "categorical"):
        networks = model(likelihood=likelihood, input="unit", nats=10.0, pyramid=False)
        networks.standardise_by(images())
        scaled = networks.scaled(images())
        latents = networks.encode(scaled)[0]
        outputs = networks.decoder(latents).detach().double()
        target = scaled.double()
        if likelihood == "calibrated":
            expected = 10.0 * (outputs - target).square().mean().log()
        elif likelihood == "gaussian":
            expected = (outputs - target).square().sum() / 2 / 7
        elif likelihood == "bernoulli":
            share = outputs.sigmoid()
            expected = -(target * share.log() + (1 - target) * (1 - share).log()).sum() / 7
        else:
            share = outputs.flatten(2).softmax(dim=-1)
            ink = target.flatten(2) / target.flatten(2).sum(dim=-1, keepdim=True)
            expected = -(ink * share.log()).sum() / 7
        loss = networks.reconstruction_loss(latents, scaled)
        assert float(loss.detach()) == pytest.approx(float(expected), rel=1e-4), likelihood


def test_a_vector_decoder_is_complete_only_with_a_linear_layer():
    """A hidden layer that happens to be as wide as the frame must not rectify the frame."""
    networks = model(STATES, decoder=({"kind": "linear", "width": 4},))
    assert float(networks.decoder(torch.randn(100, 3)).detach().min()) < 0


@pytest.mark.parametrize("likelihood", ["bernoulli", "categorical"])
def test_a_likelihood_of_shares_refuses_standardised_frames(likelihood):
    with pytest.raises(UsageError, match="input"):
        model(likelihood=likelihood, input="standardised")
