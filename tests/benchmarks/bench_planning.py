"""Planning for 20 parallel episodes against loops: at least 5 times as fast as the plain one.

OMP_NUM_THREADS=1 python -m pytest tests/benchmarks/bench_planning.py -s

The plain loop is the same planner as it would be written without batches: episode after episode,
sequence after sequence, step after step, with the same networks and settings. It plans for one
episode with a twentieth of the samples, and its rate is scaled to all of them. The other loop is
over episodes alone: it has the samples of an episode in a batch. On a CPU a thousand samples fill
the arithmetic units already, so that this one tells what the last axis is worth there.

All are timed in turn, so that a busy machine slows all down. On a GPU where torch sees one.
"""

import statistics
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from bench_training import hardware

from solar_cli.control.planning import Forecast, RolledOut, Search, cross_entropy, random_shooting
from solar_cli.models.neural import NeuralCost, NeuralDynamics
from solar_cli.settings import load_card, resolve

EPISODES = 20
ROUNDS = 5
SHARE = 0.05
"""of the samples that the plain loop tries"""
DEVICE = "cuda" if torch.cuda.is_available() else "cpu"


class Problem(NamedTuple):
    """A planner as a card has it, with untrained networks: what is learned costs no time."""

    plan: Callable[[torch.Tensor, Forecast], torch.Tensor]
    dynamics: Callable[[Any, Any], Any]
    cost: Callable[[Any, Any], Any]
    entries: int
    """of a state"""


def draws(kind: str, *shape: int) -> torch.Tensor:
    """Reproducible random numbers."""
    rng = np.random.default_rng(0)
    drawn = rng.standard_normal(shape) if kind == "normal" else rng.uniform(-1, 1, shape)
    return torch.from_numpy(drawn).float().to(DEVICE)


def cross_entropy_on_nav() -> Problem:
    configuration = resolve(load_card("nav"), "global-mpc").configuration
    settings, action = configuration.method, configuration.task.action
    search, d = settings.planner, settings.representation.latent
    dynamics = NeuralDynamics(d, d, action.size, settings.network).to(DEVICE)
    cost = NeuralCost(d, settings.network).to(DEVICE)
    normal = draws("normal", search.iterations, search.samples, search.horizon, action.size)
    hard = Search(search.iterations, search.elites, action.bound, search.std, search.least_std)

    def plan(start, forecast):
        mean = torch.zeros(len(start), search.horizon, action.size, device=DEVICE)
        return cross_entropy(forecast, mean, hard, lambda i: normal[i].clone())

    def price(states, actions):
        return cost.of(states) + 1e-3 * actions.square().sum(dim=-1)

    return Problem(plan, dynamics, price, d)


def random_shooting_on_the_car() -> Problem:
    configuration = resolve(load_card("car-states"), "mpc-nn").configuration
    settings, task = configuration.method, configuration.task
    search, d = settings.shooting, task.observation.width
    dynamics = NeuralDynamics(d, d, task.action.size, settings.network).to(DEVICE)
    actions = draws("uniform", search.samples, search.horizon, task.action.size)

    def price(states, actions):
        return (states[..., :2] - states[..., 7:9]).square().sum(dim=-1)

    return Problem(
        lambda start, forecast: random_shooting(forecast, len(start), actions), dynamics, price, d
    )


class Plain:
    """A forecast without batches, of some of the samples; the others cost infinitely much."""

    def __init__(self, problem: Problem, start: torch.Tensor) -> None:
        self.problem, self.start = problem, start

    def __call__(self, actions: torch.Tensor) -> torch.Tensor:
        costs = torch.full(actions.shape[:2], torch.inf, device=DEVICE)
        for s in range(round(SHARE * actions.shape[1])):
            state, total = self.start, torch.zeros(1, device=DEVICE)
            for action in actions[0, s]:
                state = self.problem.dynamics(state, action[None])
                total = total + self.problem.cost(state, action[None])
            costs[0, s] = total[0]
        return costs


def seconds(work: Callable[[], Any]) -> float:
    """CPU time on a CPU; on a GPU wall-clock until it is done."""
    clock = time.perf_counter if DEVICE == "cuda" else time.process_time
    began = clock()
    work()
    if DEVICE == "cuda":
        torch.cuda.synchronize()
    return clock() - began


@pytest.mark.parametrize("make", [cross_entropy_on_nav, random_shooting_on_the_car])
@torch.no_grad()
def test_planning_against_loops(make):
    torch.set_num_threads(1)
    problem = make()
    starts = draws("normal", EPISODES, problem.entries)

    def batched():
        return problem.plan(starts, RolledOut(problem.dynamics, problem.cost, starts))

    def over_episodes():
        forecasts = (RolledOut(problem.dynamics, problem.cost, one) for one in starts.split(1))
        pairs = zip(starts.split(1), forecasts, strict=True)
        return torch.cat([problem.plan(one, forecast) for one, forecast in pairs])

    def plain():
        return problem.plan(starts[:1], Plain(problem, starts[:1]))

    batched()
    rounds = [[seconds(work) for work in (batched, over_episodes, plain)] for _ in range(ROUNDS)]
    batch, loop, slow = (statistics.median(times) for times in zip(*rounds, strict=True))
    slow *= EPISODES / SHARE
    print(
        f"\n{hardware()}, {DEVICE}\n{make.__name__}: {EPISODES / batch:.0f} plans a second for "
        f"{EPISODES} episodes at once; plain loop {EPISODES / slow:.2f}, {slow / batch:.0f} times "
        f"slower; loop over episodes, samples batched: {EPISODES / loop:.0f}, "
        f"{loop / batch:.2f} times (medians of {ROUNDS})"
    )
    assert slow / batch >= 5
