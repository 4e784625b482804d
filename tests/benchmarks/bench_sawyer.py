"""Speed of Sawyer stacking in both engines, drawing included; nothing is asserted.

OMP_NUM_THREADS=1 python -m pytest tests/benchmarks/bench_sawyer.py -s
"""

import numpy as np
import pytest
from bench_envs import hardware, rate

from solar_cli.envs import build_task
from solar_cli.envs.sawyer import BACKENDS, facts
from solar_cli.settings import load_card


def down(task):
    """Steps towards the seat, sideways first, then pressing on."""
    x, y, z, yaw, lower_x, lower_y = task.truth()[0]
    aside = np.array([lower_x - x, lower_y - y])
    height = 1.5 * facts.HEIGHT + (-0.004 if np.hypot(*aside) < 0.003 else 0.015)
    wanted = np.array([*aside, height - z, -yaw / 5.0])
    return task.step(np.clip(40.0 * wanted, -1, 1)[None])


@pytest.mark.parametrize("backend", BACKENDS)
def test_task(backend):
    settings = load_card("sawyer").task
    task = build_task(settings.model_copy(update={"parameters": {"backend": backend}}))
    task.reset([np.random.default_rng(0)])
    free = rate(lambda: task.step(np.zeros((1, 4))), 1)
    for _ in range(30):
        down(task)
    pressing = rate(lambda: down(task), 1)
    stacked = task.measures()["stacked"][0]
    reset = rate(lambda: task.reset([np.random.default_rng(0)]), 1)
    print(
        f"\n{hardware()}\n{backend}: {free:,.0f} steps/s in the air, {pressing:,.0f} pressing "
        f"(stacked: {stacked}), {reset:,.0f} resets/s"
    )
