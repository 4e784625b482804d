"""The same code on a GPU: what it learns differs from the CPU's by rounding only."""

from pathlib import Path

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


def learned(task: str, device: str, folder: Path) -> tuple[dict[str, float], np.ndarray]:
    """Metrics of the first iteration, and the latents of its episodes in units of their std."""
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
    metrics = learner.iterate(Experience(environment))
    latents = learner.encode(collected_in(1, environment))
    return metrics, latents / latents.std()


@pytest.mark.parametrize("task", card_names())
def test_a_gpu_learns_what_the_cpu_learns(task, tmp_path):
    on_cpu, expected = learned(task, "cpu", tmp_path / "cpu")
    on_gpu, latents = learned(task, "cuda", tmp_path / "gpu")
    np.testing.assert_allclose(latents, expected, atol=1e-3)
    for name in ("elbo_reconstruction", "elbo_kl", "cost_r2", "one_step_r2"):
        assert on_gpu[name] == pytest.approx(on_cpu[name], rel=0.02, abs=0.02), name
