"""The cost fit against descent by torch's L-BFGS through C = L L^T, on the same moments.

OMP_NUM_THREADS=1 python -m pytest tests/benchmarks/bench_cost_fit.py -s

Twenty fits at once, as held-out R2 compares them: five ridges on four folds. Distances, whose best
quadratic is not convex everywhere, of as many states as the tasks have. Both are timed in turn, so
that a busy machine slows both down.
"""

import time

import numpy as np
import pytest
import torch
from bench_training import hardware

from solar_cli.control.convex_quadratic import Moments, least_squares
from solar_cli.inference.quadratics import squares

ROUNDS, ITERATIONS, REPEATS = 30, 100, 3
RIDGES = (1e-6, 1e-4, 1e-2, 0.1, 1.0)
SIZES = {
    "nav": (20, 50, 4),
    "car": (20, 100, 8),
    "car-states": (20, 100, 9),
    "pusher": (40, 100, 23),
}
"""episodes, steps and entries of a state"""


def problem(episodes: int, steps: int, size: int) -> tuple[Moments, torch.Tensor]:
    """Mean moments (5, 4, ...) and penalties of twenty fits."""
    rng = np.random.default_rng(0)
    z = torch.as_tensor(rng.normal(size=(episodes, steps, size)))
    costs = (z[..., : size // 2] - 1.0).norm(dim=-1) + 0.1 * torch.as_tensor(
        rng.normal(size=(episodes, steps))
    )
    costs = (costs - costs.mean()) / costs.std()
    live = torch.ones(episodes, steps, dtype=torch.bool)
    fold = torch.arange(episodes) % 4
    parts = [Moments.of(z[fold != k], costs[fold != k], live[fold != k]) for k in range(4)]
    mean = Moments.stacked([part.together() for part in parts]).mean()
    mean = mean.each(lambda part: part.expand(len(RIDGES), *part.shape))
    ridges = torch.tensor(RIDGES).double().view(-1, 1, 1)
    return mean, ridges * squares(mean.xy.shape[-1]).double()


def objective(mean: Moments, penalty: torch.Tensor, w: torch.Tensor) -> torch.Tensor:
    found: torch.Tensor = mean.error(w) + (penalty * w.square()).sum(dim=-1)
    return found


def by_lbfgs(mean: Moments, penalty: torch.Tensor, size: int) -> torch.Tensor:
    """Coefficients after a hundred iterations on the sum of all objectives."""
    L = -torch.eye(size).double().repeat(*mean.n.shape, 1, 1)
    rest = mean.xy.new_zeros(*mean.n.shape, size + 1)
    parameters = [L.requires_grad_(), rest.requires_grad_()]
    i, j = torch.tril_indices(size, size)
    halves = torch.where(i == j, 0.5, 1.0).double()

    def coefficients() -> torch.Tensor:
        diagonal = torch.nn.functional.softplus(torch.diagonal(L, dim1=-2, dim2=-1))
        cholesky = L.tril(-1) + torch.diag_embed(diagonal)
        return torch.cat([halves * (cholesky @ cholesky.mT)[..., i, j], rest], dim=-1)

    optimiser = torch.optim.LBFGS(parameters, max_iter=ITERATIONS, line_search_fn="strong_wolfe")

    def closure() -> torch.Tensor:
        optimiser.zero_grad()
        loss = objective(mean, penalty, coefficients()).sum()
        loss.backward()
        return loss

    optimiser.step(closure)
    return coefficients().detach()


@pytest.mark.parametrize("name", SIZES)
def test_the_best_convex_quadratic_is_found_faster(name: str) -> None:
    size = SIZES[name][-1]
    mean, penalty = problem(*SIZES[name])
    seconds, found = {"ours": 0.0, "L-BFGS": 0.0}, {}
    for _ in range(REPEATS):
        for which in seconds:
            began = time.perf_counter()
            if which == "ours":
                found[which] = least_squares(mean, penalty, torch.zeros_like(mean.xy), ROUNDS)
            else:
                found[which] = by_lbfgs(mean, penalty, size)
            seconds[which] += time.perf_counter() - began
    ours, theirs = (objective(mean, penalty, w) for w in found.values())
    ratio = seconds["L-BFGS"] / seconds["ours"]
    print(
        f"\n{name} on {hardware()}: {1e3 * seconds['ours'] / REPEATS:.1f} ms, {ratio:.1f} times as "
        f"fast; objectives over those of L-BFGS {float((ours / theirs).max()):.4f} at most"
    )
    assert bool((ours <= 1.01 * theirs).all())
    assert ratio > 1
