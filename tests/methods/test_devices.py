"""The same code on a GPU: what it computes differs from the CPU's by rounding only."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from collected_episodes import collected_in

from solar_cli.envs import build_task
from solar_cli.experience import Environment, Experience
from solar_cli.settings import card_names, cells, load, load_card, method
from solar_cli.streams import Streams

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="torch sees no GPU here")

# PyBullet has no wheel for every Python that has a CUDA build of torch.
BACKEND = {"sawyer": ["task.parameters.backend='mujoco'"]}


@pytest.fixture(autouse=True)
def as_the_engine_starts_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Deterministic, and without the short floats of a GPU's convolutions."""
    monkeypatch.setenv("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
    monkeypatch.setattr(torch.backends.cudnn, "allow_tf32", False)


def learner_and_world(task: str, device: str, folder: Path) -> tuple[Any, Environment]:
    """A learner of the task's smallest variant, and episodes to be collected."""
    sets = ["methods.solar.training.steps=20", *BACKEND.get(task, [])]
    [cell] = cells(load_card(task), "solar", [0], "smoke", sets)
    settings, streams = cell.configuration, Streams(0)
    environment = Environment(
        build_task(settings.task), settings.task, streams.under("environment"), folder
    )
    learner = load(method("solar").learner)(
        settings.method, settings.task, streams.under("learner"), device, lambda *_: None
    )
    environment.begin(1)
    return learner, environment


@pytest.mark.parametrize("task", card_names())
def test_a_gpu_learns_what_the_cpu_learns(task, tmp_path):
    """A learner that was moved there, and one that was trained there.

    Trained ones differ by more than rounding: Adam's first steps have the size of the rate and a
    gradient's sign, which rounding decides where there is next to none. On an H200 latents differed
    by .007 of their std on Sawyer, and by less than .001 on every other task.
    """
    on_cpu, environment = learner_and_world(task, "cpu", tmp_path / "cpu")
    expected = on_cpu.iterate(Experience(environment))
    episodes = collected_in(1, environment)

    moved, _ = learner_and_world(task, "cuda", tmp_path / "moved")
    moved.load_state_dict(on_cpu.state_dict())
    latents = on_cpu.encode(episodes)
    np.testing.assert_allclose(moved.encode(episodes), latents, atol=1e-4 * latents.std())

    on_gpu, environment = learner_and_world(task, "cuda", tmp_path / "gpu")
    metrics = on_gpu.iterate(Experience(environment))
    np.testing.assert_array_equal(collected_in(1, environment).frames, episodes.frames)
    np.testing.assert_allclose(on_gpu.encode(episodes), latents, atol=0.02 * latents.std())
    for name in ("elbo_reconstruction", "elbo_kl"):
        assert metrics[name] == pytest.approx(expected[name], rel=2e-3, abs=2e-3), name
    for name in ("cost_r2", "one_step_r2"):
        assert metrics[name] == pytest.approx(expected[name], rel=0.02, abs=0.02), name
