"""Model training against bare steps of the same networks; nothing is asserted.

OMP_NUM_THREADS=1 python -m pytest tests/benchmarks/bench_training.py -s

The peer is what anybody would write first: plain torch modules with the layers of the card, as many
frames of the same episodes a step, in the same dtype, encoded, half of them decoded; the mean
squared error and KL(q || N(0, I)), backward, one step of the same Adam. No segments, no dynamics
factors, no natural gradients, no schedules, no clipping, no pyramid.

Both are timed in turn, a block of steps each, so that a busy machine slows both down.
"""

import math
import os
import platform
import statistics
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from solar_cli.control.exploration import smooth_noise
from solar_cli.envs import build_task
from solar_cli.episodes import roll_out
from solar_cli.methods.solar import Solar
from solar_cli.models import training
from solar_cli.settings import load_card, resolve
from solar_cli.streams import Streams

BLOCKS = 15


class KeyPoints(nn.Module):
    """Expected coordinates under a softmax over pixels."""

    def __init__(self, rows, columns):
        super().__init__()
        self.sharpness = nn.Parameter(torch.ones(()))
        self.register_buffer("x", torch.linspace(-1, 1, columns))
        self.register_buffer("y", torch.linspace(1, -1, rows))

    def forward(self, maps):
        weight = torch.softmax(maps.flatten(2) * self.sharpness, dim=2).view_as(maps)
        across = torch.einsum("nchw,w->nc", weight, self.x)
        return torch.cat([across, torch.einsum("nchw,h->nc", weight, self.y)], dim=1)


class Blobs(nn.Module):
    """A frame as a sum of Gaussians."""

    def __init__(self, inputs, points, frame):
        super().__init__()
        channels, rows, columns = frame
        self.place = nn.Linear(inputs, 2 * points)
        self.precision = nn.Parameter(10 * torch.ones(points, 1))
        self.colour = nn.Parameter(torch.randn(channels, points))
        self.ground = nn.Parameter(torch.zeros(channels, 1, 1))
        self.register_buffer("x", torch.linspace(-1, 1, columns))
        self.register_buffer("y", torch.linspace(1, -1, rows))

    def forward(self, z):
        x, y = self.place(z).chunk(2, dim=1)
        across = torch.exp(-self.precision * (self.x - x[..., None]) ** 2)
        down = torch.exp(-self.precision * (self.y - y[..., None]) ** 2)
        return torch.einsum("cp,nph,npw->nchw", self.colour, down, across) + self.ground


def plain(layers, shape, frame=None):
    """Modules for a list of layers as plain dicts, and the shape of what they make."""
    modules = []
    for layer in layers:
        kind = layer["kind"]
        if kind == "unshuffle":
            f = layer["factor"]
            modules.append(nn.PixelUnshuffle(f))
            shape = (shape[0] * f * f, shape[1] // f, shape[2] // f)
        elif kind == "conv":
            size, stride, padding = layer["size"], layer["stride"], layer["padding"]
            channels, groups = layer["channels"], layer["groups"]
            modules.append(nn.Conv2d(shape[0], channels, size, stride, padding, groups=groups))
            sides = [(side + 2 * padding - size) // stride + 1 for side in shape[1:]]
            shape = (channels, *(side // layer["pool"] for side in sides))
        elif kind == "spatial_softmax":
            modules.append(KeyPoints(*shape[1:]))
            shape = (2 * shape[0],)
        elif kind == "linear":
            modules += [nn.Flatten(), nn.Linear(math.prod(shape), layer["width"])]
            shape = (layer["width"],)
        elif kind == "deconv":
            size, stride, channels = layer["size"], layer["stride"], layer["channels"]
            if len(shape) == 1:
                modules.append(nn.Unflatten(1, (-1, 1, 1)))
                shape = (shape[0], 1, 1)
            modules.append(nn.ConvTranspose2d(shape[0], channels, size, stride))
            shape = (channels, *((side - 1) * stride + size for side in shape[1:]))
        elif kind == "bumps":
            modules.append(Blobs(shape[0], layer["points"], frame))
            shape = frame
        if layer.get("activation") == "relu":
            modules.append(nn.ReLU())
        if layer.get("pool", 1) > 1:
            modules.append(nn.MaxPool2d(layer["pool"]))
    return nn.Sequential(*modules), shape


class Bare:
    """The peer: a variational auto-encoder in a dozen lines."""

    def __init__(self, representation, frames, segments, length, decoded):
        frame, latent = tuple(frames.shape[1:]), representation["latent"]
        self.encoder, features = plain(representation["encoder"], frame)
        self.heads = nn.ModuleList(nn.Linear(math.prod(features), latent) for _ in range(2))
        self.decoder, last = plain(representation["decoder"], (latent,), frame)
        if last != frame:
            whole = nn.Linear(math.prod(last), math.prod(frame))
            self.decoder = nn.Sequential(self.decoder, nn.Flatten(), whole, nn.Unflatten(1, frame))
        self.parts = nn.ModuleList([self.encoder, self.heads, self.decoder])
        self.optimiser = torch.optim.Adam(self.parts.parameters(), lr=1e-3, fused=True)
        self.frames, self.count = frames, segments * length
        self.decoded = round(decoded * self.count)
        values = frames.float()
        self.mean, self.scale = values.mean(dim=0), values.std()

    def step(self):
        rows = torch.randint(len(self.frames), (self.count,))
        x = (self.frames[rows].float() - self.mean) / self.scale
        features = self.encoder(x).flatten(1)
        mean, log_variance = (head(features) for head in self.heads)
        z = mean + (0.5 * log_variance).exp() * torch.randn_like(mean)
        error = (self.decoder(z[: self.decoded]) - x[: self.decoded]).square().mean()
        kl = (mean.square() + log_variance.exp() - log_variance - 1).sum(dim=1).mean() / 2
        self.optimiser.zero_grad()
        (error + kl).backward()
        self.optimiser.step()

    def parameters(self):
        return sum(parameter.numel() for parameter in self.parts.parameters())


def hardware():
    """One line that says what a figure was measured on."""
    information = Path("/proc/cpuinfo")
    lines = information.read_text().splitlines() if information.exists() else []
    model = next((line.split(": ")[1] for line in lines if line.startswith("model name")), "")
    return (
        f"{model or platform.processor()}, {os.cpu_count()} cores, 1 thread, "
        f"Python {platform.python_version()}, torch {torch.__version__}"
    )


def white_noise(configuration):
    """The episodes that the first model is trained on."""

    class Noise:
        def start(self, episodes, stream):
            shape = (episodes, task.horizon, task.action.size)
            return task.exploration.std * smooth_noise(shape, task.exploration.smoothing, stream)

        def act(self, observations, t, state):
            return state[:, t], np.zeros_like(state[:, t]), state

    task, streams = configuration.task, Streams(0)
    count = configuration.method.batches.initial
    count -= round(configuration.method.training.held_out * count)
    resets = [streams.generator("reset", i) for i in range(count)]
    return roll_out(build_task(task), task, Noise(), resets, streams.generator("noise")).episodes


@pytest.mark.parametrize("name", ["nav"])
def test_training_against_bare_steps(name):
    torch.set_num_threads(1)
    torch.use_deterministic_algorithms(True)  # as in a worker
    torch.utils.deterministic.fill_uninitialized_memory = False
    configuration = resolve(load_card(name), "solar").configuration
    settings = configuration.method
    episodes = white_noise(configuration)
    frames = torch.from_numpy(episodes.frames).flatten(0, 1)
    wanted = settings.training
    bare = Bare(
        settings.model_dump()["representation"],
        frames,
        wanted.segments,
        wanted.length,
        wanted.decoded,
    )
    block = training.PULSE_STEPS
    ours, theirs = [], []

    def pulse(*_):
        """Between two blocks of ours, one of theirs."""
        ours.append(time.process_time() - pulse.began)
        began = time.process_time()
        for _ in range(block):
            bare.step()
        theirs.append(time.process_time() - began)
        pulse.began = time.process_time()

    learner = Solar(settings, configuration.task, Streams(0), "cpu", pulse)
    model = learner.representation._model
    model.networks.standardise_by(frames)
    pulse.began = time.process_time()
    learner.representation._trainer.fit("benchmark", model, [episodes], BLOCKS * block)
    end = time.process_time() - pulse.began
    own = sum(parameter.numel() for parameter in model.networks.parameters())
    a, b = (1e3 * statistics.median(times[1:]) / block for times in (ours, theirs))
    ratios = sorted(x / y for x, y in zip(ours[1:], theirs[1:], strict=True))
    print(
        f"\n{hardware()}\n"
        f"{name}, {bare.count} frames a step ({bare.decoded} decoded): "
        f"training {a:.2f} ms a step ({own:,} parameters), "
        f"bare {b:.2f} ms ({bare.parameters():,}): {statistics.median(ratios):.2f} times "
        f"(CPU time, median of {len(ratios)} blocks of {block} steps; "
        f"{ratios[0]:.2f} to {ratios[-1]:.2f}); "
        f"conclusion with all {len(episodes)} episodes {1e3 * end:.0f} ms"
    )
