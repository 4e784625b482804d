"""Layers against torch's functions by hand, and against what can be computed on paper."""

import math

import numpy as np
import pytest
import torch
from pydantic import TypeAdapter
from torch.nn import functional

from solar_cli.errors import UsageError
from solar_cli.models.networks import build
from solar_cli.settings import load_card, resolve
from solar_cli.settings.networks import BUMPS, KEY_POINTS, Layer

LAYERS = TypeAdapter(tuple[Layer, ...])


def network(*tables, shape, frame=()):
    """What a card's list of tables becomes, with weights that are far from their initial ones."""
    torch.manual_seed(0)
    module, out = build(LAYERS.validate_python(tables), shape, frame)
    for parameter in module.parameters():
        torch.nn.init.normal_(parameter, std=0.5)
    return module, out


def batch(*shape):
    return torch.randn(3, *shape, generator=torch.Generator().manual_seed(1))


def weights(module):
    return dict(module.named_parameters())


def test_unshuffle_moves_blocks_into_channels():
    module, shape = network({"kind": "unshuffle", "factor": 3}, shape=(2, 6, 9))
    x = batch(2, 6, 9)
    blocks = x.reshape(3, 2, 2, 3, 3, 3).permute(0, 1, 3, 5, 2, 4)
    assert shape == (18, 2, 3)
    torch.testing.assert_close(module(x), blocks.reshape(3, 18, 2, 3), rtol=0, atol=0)


def test_shuffle_undoes_unshuffle():
    module, shape = network(
        {"kind": "unshuffle", "factor": 3}, {"kind": "shuffle", "factor": 3}, shape=(2, 6, 9)
    )
    assert shape == (2, 6, 9)
    torch.testing.assert_close(module(batch(2, 6, 9)), batch(2, 6, 9), rtol=0, atol=0)


@pytest.mark.parametrize("activation", ["relu", "none"])
@pytest.mark.parametrize(
    "more", [{}, {"stride": 2}, {"padding": 2}, {"groups": 2}, {"pool": 2}, {"size": 1}]
)
def test_convolution(more, activation):
    table = {"kind": "conv", "channels": 6, "size": 3, "activation": activation} | more
    module, shape = network(table, shape=(4, 9, 8))
    x, w = batch(4, 9, 8), weights(module)
    expected = functional.conv2d(
        x,
        w["0.weight"],
        w["0.bias"],
        stride=more.get("stride", 1),
        padding=more.get("padding", 0),
        groups=more.get("groups", 1),
    )
    expected = expected.clamp_min(0) if activation == "relu" else expected
    if "pool" in more:
        expected = functional.max_pool2d(expected, 2)
    assert shape == expected.shape[1:]
    torch.testing.assert_close(module(x), expected, rtol=1e-5, atol=1e-5)  # float32 sums of 36


def test_groups_are_towers_that_share_nothing():
    tables = [{"kind": "conv", "channels": 4, "size": 2, "groups": 2, "activation": "none"}] * 2
    module, _ = network(*tables, shape=(2, 5, 5))
    x = batch(2, 5, 5).requires_grad_()
    module(x)[:, :2].square().sum().backward()
    assert x.grad[:, 0].abs().min(dim=0).values.max() > 0
    assert x.grad[:, 1].abs().max() == 0


@pytest.mark.parametrize("activation", ["relu", "none"])
@pytest.mark.parametrize("shape", [(5,), (2, 3, 4)])
def test_linear_layers_flatten_what_they_get(shape, activation):
    module, out = network({"kind": "linear", "width": 7, "activation": activation}, shape=shape)
    x = batch(*shape)
    weight, bias = (p.detach().numpy() for p in module.parameters())
    expected = x.reshape(3, -1).numpy() @ weight.T + bias
    expected = np.maximum(expected, 0) if activation == "relu" else expected
    assert out == (7,)
    np.testing.assert_allclose(module(x).detach(), expected, atol=1e-5)


@pytest.mark.parametrize("activation", ["relu", "none"])
@pytest.mark.parametrize(("shape", "image"), [((3, 2, 4), (3, 2, 4)), ((5,), (5, 1, 1))])
def test_a_deconvolution_lays_its_filter_where_every_pixel_points(shape, image, activation):
    table = {"kind": "deconv", "channels": 2, "size": 3, "stride": 2, "activation": activation}
    module, out = network(table, shape=shape)
    x = batch(*shape)
    weight, bias = (p.detach().numpy() for p in module.parameters())
    channels, rows, columns = image
    expected = np.zeros((3, 2, 2 * (rows - 1) + 3, 2 * (columns - 1) + 3)) + bias[:, None, None]
    pixels = x.reshape(3, *image).numpy()
    for c in range(channels):
        for r in range(rows):
            for k in range(columns):
                place = np.s_[:, :, 2 * r : 2 * r + 3, 2 * k : 2 * k + 3]
                expected[place] += pixels[:, c, r, k, None, None, None] * weight[c]
    expected = np.maximum(expected, 0) if activation == "relu" else expected
    assert out == expected.shape[1:]
    np.testing.assert_allclose(module(x).detach(), expected, atol=1e-5)


# Spatial softmax: x is to the right, y is up, both within [-1, 1]


def softmax(log_sharpness=0.0, shape=(1, 5, 9)):
    layers = LAYERS.validate_python([{"kind": "spatial_softmax", "log_sharpness": log_sharpness}])
    module, out = build(layers, shape)
    assert out == (2 * shape[0],)
    return module


@pytest.mark.parametrize(
    ("row", "column", "x", "y"),
    [(0, 0, -1.0, 1.0), (4, 8, 1.0, -1.0), (2, 4, 0.0, 0.0), (1, 6, 0.5, 0.5), (4, 0, -1.0, -1.0)],
)
def test_a_hot_pixel_is_where_it_is(row, column, x, y):
    maps = torch.zeros(1, 1, 5, 9)
    maps[0, 0, row, column] = 60.0
    # exp(-60) of the weight is elsewhere.
    torch.testing.assert_close(softmax()(maps)[0], torch.tensor([x, y]), rtol=0, atol=1e-6)


def test_a_symmetric_blob_is_at_its_centre():
    rows, columns = torch.meshgrid(torch.arange(9), torch.arange(9), indexing="ij")
    blob = torch.exp(-0.5 * ((rows - 5) ** 2 + (columns - 2) ** 2))
    maps = torch.where((rows - 5).abs().maximum((columns - 2).abs()) <= 2, blob, -torch.inf)
    found = softmax(shape=(1, 9, 9))(maps[None, None])[0]
    torch.testing.assert_close(found, torch.tensor([2 / 4 - 1, 1 - 5 / 4]), rtol=0, atol=1e-6)


def test_a_flat_map_is_at_the_middle():
    torch.testing.assert_close(
        softmax()(torch.ones(1, 1, 5, 9)), torch.zeros(1, 2), rtol=0, atol=1e-6
    )


@pytest.mark.parametrize("log_sharpness", [-1.0, 0.0, 1.5])
def test_the_sharpness_is_the_factor_on_the_maps(log_sharpness):
    maps = torch.full((1, 1, 1, 7), -torch.inf)
    maps[..., 0], maps[..., -1] = 0.2, 0.9
    # Two pixels at -1 and 1: the mean of a two-way softmax is a hyperbolic tangent.
    expected = math.tanh(math.exp(log_sharpness) * (0.9 - 0.2) / 2)
    found = softmax(log_sharpness, (1, 1, 7))(maps)[0, 0].detach()
    assert float(found) == pytest.approx(expected, abs=1e-6)


def test_coordinates_are_x_of_all_channels_then_y_of_all():
    maps = torch.zeros(1, 2, 5, 9)
    maps[0, 0, 1, 2] = maps[0, 1, 4, 8] = 60.0
    expected = torch.tensor([[-0.5, 1.0, 0.5, -1.0]])
    torch.testing.assert_close(softmax(shape=(2, 5, 9))(maps), expected, rtol=0, atol=1e-6)


def test_the_sharpness_is_learned():
    module = softmax(0.5)
    [parameter] = module.parameters()
    module(batch(1, 5, 9)).square().sum().backward()
    assert parameter.grad.abs() > 0


# Bumps: the decoder's counterpart


def test_bumps_are_gaussians_at_linear_coordinates():
    points, width, frame = 3, 0.4, (2, 6, 8)
    layers = LAYERS.validate_python([{"kind": "bumps", "points": points, "width": width}])
    module, shape = build(layers, (4,), frame)
    for parameter in (module[0].place.weight, module[0].place.bias, module[0].ground):
        torch.nn.init.normal_(parameter, std=0.5)
    inputs = batch(4)
    w = {name: p.detach().double().numpy() for name, p in module[0].named_parameters()}
    places = inputs.double().numpy() @ w["place.weight"].T + w["place.bias"]
    expected = np.zeros((3, *frame)) + w["ground"]
    for n, c, r, k, p in np.ndindex(3, *frame, points):
        x, y = -1 + 2 * k / 7, 1 - 2 * r / 5
        squared = (x - places[n, p]) ** 2 + (y - places[n, points + p]) ** 2
        expected[n, c, r, k] += w["colour"][c, p] * math.exp(-squared / (2 * width**2))
    assert shape == frame
    np.testing.assert_allclose(module(inputs).detach(), expected, atol=1e-5)


def test_all_of_a_bump_is_learned():
    module, _ = network({"kind": "bumps", "points": 3}, shape=(4,), frame=(2, 6, 8))
    module(batch(4)).square().sum().backward()
    assert all(parameter.grad.abs().max() > 0 for parameter in module.parameters())


def test_bumps_start_with_the_width_of_the_card():
    layers = LAYERS.validate_python([{"kind": "bumps", "points": 2, "width": 0.2}])
    module, _ = build(layers, (3,), (1, 21, 21))
    with torch.no_grad():
        module[0].place.weight.zero_()
        module[0].place.bias.zero_()
        module[0].colour.copy_(torch.tensor([[1.0, 0.0]]))
    frame = module(torch.zeros(1, 3)).detach()[0, 0]
    # Two pixels from the middle is 0.2, one standard deviation.
    assert float(frame[10, 10]) == pytest.approx(1.0, abs=1e-6)
    assert float(frame[10, 12]) == pytest.approx(math.exp(-0.5), abs=1e-6)
    assert float(frame[8, 12]) == pytest.approx(math.exp(-1.0), abs=1e-6)


def test_maps_are_gaussians_at_linear_coordinates():
    points, width, frame = 3, 0.4, (2, 12, 16)
    layers = LAYERS.validate_python(
        [{"kind": "maps", "points": points, "width": width, "factor": 2}]
    )
    module, shape = build(layers, (4,), frame)
    for parameter in (module[0].place.weight, module[0].place.bias):
        torch.nn.init.normal_(parameter, std=0.5)
    inputs = batch(4)
    w = {name: p.detach().double().numpy() for name, p in module[0].named_parameters()}
    places = inputs.double().numpy() @ w["place.weight"].T + w["place.bias"]
    expected = np.zeros((3, points, 6, 8))
    for n, p, r, k in np.ndindex(expected.shape):
        x, y = -1 + 2 * k / 7, 1 - 2 * r / 5
        squared = (x - places[n, p]) ** 2 + (y - places[n, points + p]) ** 2
        expected[n, p, r, k] = math.exp(-squared / (2 * width**2))
    assert shape == (points, 6, 8)
    np.testing.assert_allclose(module(inputs).detach(), expected, atol=1e-5)


# Whole lists


CAR = [{"kind": "conv", "channels": 4, "size": 4}] * 2 + [
    {"kind": "conv", "channels": 4, "size": 4, "activation": "none"},
    *({"kind": "linear", "width": width} for width in (64, 32)),
]
REACHER = [{"kind": "conv", "channels": c, "size": 2, "pool": 2} for c in (8, 6, 4)]
SAWYER = [
    {"kind": "linear", "width": 16},
    {"kind": "deconv", "channels": 8, "size": 5, "stride": 2},
    {"kind": "deconv", "channels": 4, "size": 6, "stride": 3},
    {"kind": "deconv", "channels": 3, "size": 6, "stride": 3, "activation": "none"},
]
STAMPS = [
    {"kind": "maps", "points": 5, "factor": 2},
    {"kind": "conv", "channels": 8, "padding": 1},
    {"kind": "conv", "channels": 4, "padding": 1, "activation": "none"},
    {"kind": "shuffle", "factor": 2},
]


@pytest.mark.parametrize(
    ("layers", "shape"),
    [
        (CAR, (1, 64, 64)),
        (REACHER, (3, 64, 64)),
        (SAWYER, (5,)),
        (KEY_POINTS, (2, 32, 32)),
        (BUMPS, (4,)),
        (STAMPS, (4,)),
        ([], (4,)),
    ],
)
def test_the_shape_that_is_promised_is_the_shape_that_comes(layers, shape):
    module, promised = build(LAYERS.validate_python(layers), shape, (1, 8, 6))
    assert tuple(module(batch(*shape)).shape) == (3, *promised)


@pytest.mark.parametrize("variant", load_card("nav").variants)
def test_the_networks_of_the_card_fit_its_frames(variant):
    configuration = resolve(load_card("nav"), "solar", variant).configuration
    frame = configuration.task.observation.frame_shape
    representation = configuration.method.representation
    encoder, features = build(representation.encoder, frame)
    assert tuple(encoder(batch(*frame)).shape[1:]) == features
    decoder, last = build(representation.decoder, (representation.latent,), frame)
    assert tuple(decoder(batch(representation.latent)).shape[1:]) == last


@pytest.mark.parametrize(
    ("tables", "shape", "message"),
    [
        ([{"kind": "conv", "channels": 2, "size": 9}], (1, 8, 8), r"layer 1 \(conv\)"),
        ([{"kind": "conv", "channels": 2, "size": 3}], (8,), r"layer 1 \(conv\).*image"),
        ([{"kind": "conv", "channels": 2, "size": 3, "pool": 7}], (1, 8, 8), r"layer 1 \(conv\)"),
        (
            [{"kind": "conv", "channels": 4}, {"kind": "conv", "channels": 6, "groups": 3}],
            (2, 8, 8),
            r"layer 2 \(conv\).*3 groups",
        ),
        ([{"kind": "conv", "channels": 4, "groups": 3}], (3, 8, 8), r"layer 1 \(conv\).*3 groups"),
        (
            [{"kind": "unshuffle", "factor": 4}],
            (2, 8, 10),
            r"layer 1 \(unshuffle\).*multiples of 4",
        ),
        ([{"kind": "unshuffle", "factor": 2}], (8,), r"layer 1 \(unshuffle\)"),
        (
            [{"kind": "linear", "width": 8}, {"kind": "spatial_softmax"}],
            (2, 8, 8),
            r"layer 2 \(spatial_softmax\).*\(8,\)",
        ),
        (
            [{"kind": "conv", "channels": 10**6, "size": 8}],
            (2, 8, 8),
            r"layer 1.*128000000 weights",
        ),
        ([{"kind": "deconv", "channels": 10**6, "size": 8}], (2,), r"layer 1.*128000000 weights"),
        ([{"kind": "linear", "width": 10**60}], (2, 8, 8), r"layer 1 \(linear\).* weights"),
        (
            [{"kind": "conv", "channels": 1, "size": 1, "padding": 10**4}],
            (1, 8, 8),
            r"layer 1.* outputs",
        ),
        ([{"kind": "bumps", "points": 2}], (2, 8, 8), r"layer 1 \(bumps\)"),
        ([{"kind": "bumps", "points": 2}], (8,), r"layer 1 \(bumps\).*images"),
        ([{"kind": "maps", "points": 2, "factor": 4}], (8,), r"layer 1 \(maps\).*images"),
        ([{"kind": "shuffle", "factor": 2}], (2, 8, 8), r"layer 1 \(shuffle\).*multiple of 4"),
    ],
)
def test_a_layer_that_does_not_fit_is_named(tables, shape, message):
    with pytest.raises(UsageError, match=message):
        build(LAYERS.validate_python(tables), shape)
