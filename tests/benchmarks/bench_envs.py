"""Speed of the tasks against peers in the same run; nothing is asserted.

OMP_NUM_THREADS=1 python -m pytest tests/benchmarks/bench_envs.py -s
"""

import os
import platform
import time
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from solar_cli.envs import build_task
from solar_cli.envs.front_ends import IDS
from solar_cli.envs.offscreen import load_mujoco, make_renderer
from solar_cli.envs.rasteriser import Box, Disc, draw_blobs, draw_figure
from solar_cli.envs.reacher import MODEL
from solar_cli.settings import load_card

BATCH = 128
NAMES = ["Solar/Navigation-v0", "Solar/Car-v0", "Solar/CarStates-v0", "Solar/Reacher-v0"]


def hardware():
    """One line that says what a figure was measured on."""
    information = Path("/proc/cpuinfo")
    lines = information.read_text().splitlines() if information.exists() else []
    model = next((line.split(": ")[1] for line in lines if line.startswith("model name")), "")
    return (
        f"{model or platform.processor()}, {os.cpu_count()} cores, "
        f"OMP_NUM_THREADS={os.environ.get('OMP_NUM_THREADS', 'unset')}, "
        f"Python {platform.python_version()}, NumPy {np.__version__}"
    )


def rate(call, count, seconds=0.3, rounds=5):
    """Best of several rounds, in ``count`` per second: the other rounds were disturbed."""
    call()
    best = 0.0
    for _ in range(rounds):
        calls, start = 0, time.perf_counter()
        while (elapsed := time.perf_counter() - start) < seconds:
            call()
            calls += 1
        best = max(best, calls * count / elapsed)
    return best


@pytest.fixture(scope="module", autouse=True)
def hardware_line():
    print(f"\n{hardware()}")


def actions(settings, batch):
    return np.random.default_rng(0).normal(0.0, settings.exploration.std, (batch, 2))


@pytest.mark.parametrize("card", [IDS[name] for name in NAMES])
@pytest.mark.parametrize("batch", [1, 16, 64, 128, 256])
def test_task(card, batch):
    settings = load_card(card).task
    task = build_task(settings)
    task.reset([np.random.default_rng(i) for i in range(batch)])
    moves = actions(settings, batch)
    print(f"{card}, core, batch {batch}: {rate(lambda: task.step(moves), batch):,.0f} steps/s")


@pytest.mark.parametrize("name", NAMES)
def test_batched_environment_against_a_loop_over_singles(name):
    batched = gymnasium.make_vec(name, num_envs=BATCH)
    loop = gymnasium.make_vec(
        name,
        num_envs=BATCH,
        vectorization_mode="sync",
        vector_kwargs={"autoreset_mode": AutoresetMode.SAME_STEP},
    )
    moves = actions(load_card(IDS[name]).task, BATCH).astype(np.float32)
    speeds = []
    for env in (batched, loop):
        env.reset(seed=0)
        speeds.append(rate(lambda env=env: env.step(moves), BATCH))
    print(
        f"{name}, Gymnasium, batch {BATCH}: batched {speeds[0]:,.0f} steps/s, SyncVectorEnv "
        f"{speeds[1]:,.0f}: {speeds[0] / speeds[1]:.1f} times"
    )


def whole_frames(images, centres):
    """The peer of `draw_blobs`: every pixel of every image, straight from the formula."""
    rows, columns = np.mgrid[: images.shape[1], : images.shape[2]]
    down = rows - centres[:, 0, None, None]
    across = columns - centres[:, 1, None, None]
    images[:] = np.rint(255.0 * np.exp(-0.5 * (down**2 + across**2)))


def test_rasteriser_against_whole_frames():
    centres = np.random.default_rng(0).uniform(2, 29, (BATCH, 2))
    patches = np.zeros((BATCH, 32, 32), np.uint8)
    whole = np.zeros_like(patches)
    ours = rate(lambda: draw_blobs(patches, centres, 1.0), BATCH)
    peer = rate(lambda: whole_frames(whole, centres), BATCH)
    print(
        f"blobs, batch {BATCH}: patches {ours:,.0f} images/s, whole frames {peer:,.0f}: "
        f"{ours / peer:.1f} times; equal images: {np.array_equal(patches, whole)}"
    )


def test_figures_against_whole_frames():
    figure = (Box((0.0, 0.0), (7.2, 3.6), 255.0), Box((2.4, 0.0), (1.4, 2.9), 0.0))
    everywhere = (*figure, Disc((500.0, 0.0), 0.0, 0.0))  # shows nowhere, but reaches far
    draws = np.random.default_rng(0)
    centres, headings = draws.uniform(4, 59, (BATCH, 2)), draws.uniform(-3, 3, BATCH)
    images = np.zeros((BATCH, 64, 64), np.uint8)
    ours = rate(lambda: draw_figure(images, centres, headings, figure), BATCH)
    peer = rate(lambda: draw_figure(images, centres, headings, everywhere), BATCH)
    print(
        f"figures, batch {BATCH}: patches {ours:,.0f} images/s, whole frames {peer:,.0f}: "
        f"{ours / peer:.1f} times"
    )


def test_drawing_against_mujocos_own_quality():
    mujoco, speeds = load_mujoco(), []
    for own in (True, False):
        model = mujoco.MjModel.from_xml_path(str(MODEL))
        if not own:
            usual = mujoco.MjModel.from_xml_string("<mujoco/>").vis.quality
            for name in ("numslices", "numstacks", "offsamples", "shadowsize"):
                setattr(model.vis.quality, name, getattr(usual, name))
        data, renderer = mujoco.MjData(model), make_renderer(model, 64, 64)
        mujoco.mj_forward(model, data)
        renderer.update_scene(data, "above")
        speeds.append(rate(renderer.render, 1))
    print(
        f"reacher, drawing: {speeds[0]:,.0f} images/s, with MuJoCo's own quality "
        f"{speeds[1]:,.0f}: {speeds[0] / speeds[1]:.1f} times"
    )
