"""The ELBO of a tiny model: by hand, and its gradient against finite differences. float64."""

import numpy as np
import pytest
import torch
from model_problems import vector_episodes, vector_task

from solar_cli.models import latent_model
from solar_cli.models.frames import FrameModel
from solar_cli.models.latent_model import LatentModel, Minibatch
from solar_cli.models.priors import BayesianLDS, StandardNormal
from solar_cli.settings.local import Dynamics, Representation

TASK = vector_task(horizon=5, width=3, window=2)
D = 2


def tiny(prior="linear", standard_normal=0.05, **settings) -> LatentModel:
    torch.manual_seed(0)
    layers = ({"kind": "linear", "width": 4, "activation": "none"},)
    table = {"latent": D, "encoder": layers, "decoder": layers, "likelihood": "gaussian"}
    networks = FrameModel(Representation.model_validate(table | settings), TASK.observation)
    chosen = BayesianLDS(Dynamics(), D, TASK, "cpu") if prior == "linear" else StandardNormal()
    return LatentModel(networks.double(), chosen, standard_normal)


def minibatch(seed=1, segments=3, length=4, decoded=(0, 3, 5, 11)) -> Minibatch:
    rng = np.random.default_rng(seed)
    return Minibatch(
        torch.as_tensor(rng.normal(size=(segments, length, 3)).astype(np.float32)),
        torch.as_tensor(rng.normal(size=(segments, length - 1, 2))),
        torch.tensor([0, 1, 0]),
        torch.as_tensor(rng.normal(size=(segments, length, D)).astype(np.float32)),
        torch.tensor(decoded),
    )


def taught(model: LatentModel) -> LatentModel:
    model.prior.conclude(model.encoded(vector_episodes(TASK, 6), "cpu"))
    return model


def finite_difference(loss, parameter, index, step=1e-5):
    """Fourth-order central difference: exact to 1e-10 for losses of order one."""
    with torch.no_grad():
        start = float(parameter[index])
        values = []
        for k in (-2, -1, 1, 2):
            parameter[index] = start + k * step
            values.append(loss())
        parameter[index] = start
    return (values[0] - 8 * values[1] + 8 * values[2] - values[3]) / (12 * step)


@pytest.mark.parametrize("prior", ["linear", "normal"])
@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"likelihood": "calibrated", "nats": 3.0},
        {"variance": 0.01},
        {"decoder": ({"kind": "linear", "width": 3},)},
    ],
    ids=["gaussian", "calibrated", "fixed variance", "rectified"],
)
def test_elbo_gradients_are_those_of_finite_differences(prior, settings):
    model = taught(tiny(prior, **settings))
    torch.nn.init.normal_(model.networks.mean[-1].weight)
    for name, parameter in model.networks.named_parameters():
        if "log_variance" in name:
            torch.nn.init.normal_(parameter, std=0.3)
    batch = minibatch()

    def loss() -> float:
        return float(model.loss(batch, 0.7)[0])

    model.loss(batch, 0.7)[0].backward()
    rng = np.random.default_rng(2)
    for name, parameter in model.networks.named_parameters():
        for _ in range(3):
            index = tuple(int(rng.integers(size)) for size in parameter.shape)
            expected = finite_difference(loss, parameter, index)
            found = float(parameter.grad[index])
            assert found == pytest.approx(expected, rel=1e-6, abs=1e-7), (name, index)


def test_the_loss_is_the_negative_elbo_by_hand():
    model = tiny("normal", standard_normal=0.3)
    batch = minibatch()
    loss, segments, terms = model.loss(batch, 0.7)
    w = {name: p.detach().numpy() for name, p in model.networks.named_parameters()}
    x = batch.frames.double().numpy().reshape(12, 3)
    hidden = x @ w["body.0.weight"].T + w["body.0.bias"]
    mean = hidden @ w["mean.1.weight"].T + w["mean.1.bias"]
    log_variance = hidden @ w["log_variance.1.weight"].T + w["log_variance.1.bias"]
    variance = np.exp(log_variance)
    z = mean + np.sqrt(variance) * batch.noise.double().numpy().reshape(12, D)
    drawn = z @ w["decoder.0.weight"].T + w["decoder.0.bias"]
    drawn = drawn @ w["decoder.1.weight"].T + w["decoder.1.bias"]
    chosen = batch.decoded.numpy()
    reconstruction = 0.5 * np.square(drawn - x)[chosen].sum() / len(chosen)
    kl = 0.5 * (mean**2 + variance - 1 - log_variance).sum() / 12
    assert float(loss.detach()) == pytest.approx(reconstruction + 0.7 * 1.3 * kl, rel=1e-6)
    assert float(terms["elbo_reconstruction"].detach()) == pytest.approx(-reconstruction, rel=1e-6)
    assert float(terms["elbo_kl"].detach()) == pytest.approx(kl, rel=1e-6)
    np.testing.assert_allclose(segments.mean.detach().reshape(12, D), mean, rtol=1e-6)
    np.testing.assert_allclose(segments.variance.detach().reshape(12, D), variance, rtol=1e-6)


def test_the_weight_scales_the_kl_terms_and_nothing_else():
    model = taught(tiny())
    losses = [float(model.loss(minibatch(), weight)[0].detach()) for weight in (0.0, 1.0, 3.0)]
    assert losses[2] - losses[0] == pytest.approx(3 * (losses[1] - losses[0]), rel=1e-9)
    _, segments, terms = model.loss(minibatch(), 0.0)
    assert losses[0] == pytest.approx(-float(terms["elbo_reconstruction"].detach()), rel=1e-12)
    kl = float(model.prior.kl(segments).detach())
    assert float(terms["elbo_kl"].detach()) == pytest.approx(kl, rel=1e-12)


def test_only_the_chosen_frames_are_decoded():
    model, batch = taught(tiny()), minibatch(decoded=(2, 7))
    drawn = []
    decoder = model.networks.decoder.forward
    model.networks.decoder.forward = lambda z: drawn.append(len(z)) or decoder(z)
    model.loss(batch, 1.0)
    assert drawn == [2]


def test_embedding_in_chunks_is_embedding(monkeypatch):
    model, episodes = tiny(), vector_episodes(TASK, 4)
    frames = torch.from_numpy(episodes.frames).flatten(0, 1)
    whole = model.embed(frames)
    monkeypatch.setattr(latent_model, "CHUNK", 5)
    for left, right in zip(model.embed(frames), whole, strict=True):
        torch.testing.assert_close(left, right, rtol=1e-12, atol=1e-12)


def test_the_posterior_of_episodes_is_frame_by_frame():
    model, episodes = tiny(), vector_episodes(TASK, 4)
    found = model.encoded(episodes, "cpu")
    assert found.mean.shape == found.variance.shape == (4, 6, D)
    assert found.start.tolist() == [0] * 4
    assert torch.equal(found.actions, torch.from_numpy(episodes.actions))
    one = model.networks.encode(model.networks.scaled(torch.from_numpy(episodes.frames[2, 3:4])))
    torch.testing.assert_close(found.mean[2, 3], one[0][0].detach(), rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(found.variance[2, 3], one[1][0].detach(), rtol=1e-12, atol=1e-12)
