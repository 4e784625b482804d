"""What cells will take: measured on finished seeds of the same kind, and foreseen by size."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from solar_cli.control import quadratic_cost
from solar_cli.control.trajectories import Trajectories
from solar_cli.experiment.estimates import (
    WORKER_BYTES,
    Estimate,
    estimate,
    measured_speeds,
    memory_needs,
)
from solar_cli.experiment.judge import Judge
from solar_cli.experiment.matrix import Action, Plan
from solar_cli.settings import Cell, cells, load_card
from solar_cli.settings.local import CostFit
from solar_cli.store.owner import Owner
from solar_cli.store.records import Outcome
from solar_cli.store.store import Store


def computed(
    store: Store, cell: Cell, episodes: int, seconds: float, outcome: Outcome = Outcome.FINISHED
) -> None:
    store.add([cell])
    number = store.claim(cell.hash, Owner.current(), episodes, {})
    store.commit(
        cell.hash,
        number,
        iteration=1,
        episodes=episodes,
        steps=0,
        simulated_seconds=0.0,
        seconds=seconds,
    )
    store.end(cell.hash, number, outcome)
    store.folder(cell.hash).mkdir(parents=True)
    (store.folder(cell.hash) / "checkpoint").write_bytes(bytes(300))
    (store.folder(cell.hash) / "episodes").mkdir()
    (store.folder(cell.hash) / "episodes" / "file").write_bytes(bytes(episodes * 10))


def test_time_and_disk_follow_the_pace_of_finished_seeds(
    store: Store, make_cells: Callable[..., list[Cell]]
) -> None:
    one, two, broken, new, half = make_cells(5)
    computed(store, one, 10, 20.0)
    computed(store, two, 30, 100.0)  # together 3 seconds and 10 bytes an episode, and 300 bytes
    computed(store, broken, 10, 9999.0, Outcome.FAILED)
    computed(store, half, 25, 9999.0, Outcome.INTERRUPTED)
    plans = [
        Plan(new, 100, Action.RUN, "why"),
        Plan(half, 100, Action.RESUME, "why", store.find(half.hash)),
        Plan(half, 100, Action.REDO, "why", store.find(half.hash)),
        Plan(one, 10, Action.SKIP, "why", store.find(one.hash)),
    ]
    assert estimate(store, plans) == [
        Estimate(300.0, WORKER_BYTES, 1300),
        Estimate(225.0, WORKER_BYTES, 1300),
        Estimate(300.0, WORKER_BYTES, 1300),
        Estimate(0.0, 0, 0),
    ]


class Still:
    """Does nothing."""

    def start(self, episodes, stream):
        return np.zeros((episodes, 2))

    def act(self, observations, t, state):
        return state, state, state


def test_what_is_held_in_memory_is_foreseen() -> None:
    sets = ["task.observation.window=2", "task.horizon=7", "evaluation.episodes=5"]
    [cell] = cells(load_card("nav"), "solar", [0], sets=sets)
    evaluated = Judge(cell).evaluate(Still(), 0).episodes
    parts = (evaluated.frames, evaluated.actions, evaluated.action_means, evaluated.costs)
    held = sum(part.nbytes for part in parts)
    evaluation, batch, minibatch, dynamics, _, weights = memory_needs(cell)
    assert evaluation.bytes == held
    assert batch.bytes == held / 5 * 80  # the card's first batch
    assert minibatch.bytes == evaluated.frames[:1, :4].nbytes * 30  # the card's segments
    assert dynamics.bytes == np.zeros((7, 4 * 2, 4 * 2)).nbytes  # d = 4, two frames a window
    assert weights.bytes == np.zeros((7, 7)).nbytes


def test_frames_of_a_state_are_single_precision() -> None:
    [image] = cells(load_card("nav"), "solar", [0])
    vector = 'task.observation={kind="state", width=512}'  # 4 bytes an entry: 2048, as the images
    [state] = cells(load_card("nav"), "solar", [0], sets=[vector])
    assert memory_needs(state)[0].bytes == memory_needs(image)[0].bytes


@pytest.mark.parametrize(("name", "latents"), [("solar", 4), ("lqr-flm", 20)])
def test_moments_of_the_cost_fit_are_those_that_it_holds(
    monkeypatch: pytest.MonkeyPatch, name: str, latents: int
) -> None:
    """Of LQR-FLM they are more than its episodes: a limit for principal components."""
    [cell] = cells(load_card("nav"), name, [0])
    T, rng = cell.configuration.task.horizon, np.random.default_rng(0)
    z = torch.as_tensor(rng.normal(size=(8, T + 1, latents)))
    costs = z[:, :-1].square().sum(dim=-1)
    actions = torch.zeros(8, T, 2).double()
    held: list[int] = []

    def looked_at(folds: list[Any], whole: Any, *_: Any) -> tuple[Any, Any]:
        held.extend(part.xx.nbytes for part in (*folds, whole))
        choice = quadratic_cost.Choice(0.0, 0.0, per_time=False)
        return choice, quadratic_cost.Score(1.0, 1.0)

    monkeypatch.setattr(quadratic_cost, "_chosen", looked_at)
    states = Trajectories(z, actions, actions, costs, costs > -1)
    quadratic_cost.fit_quadratic_cost(states, [], 0.0, CostFit(), latents)
    [need] = [need for need in memory_needs(cell) if need.what == "moments of the cost fit"]
    assert need.bytes == sum(held)
    assert need.settings[0].endswith("latent" if name == "solar" else "components")


@pytest.mark.parametrize(
    ("task", "name", "planner"),
    [
        ("nav", "global-mpc", "planner"),
        ("nav", "pixel-mpc", "planner"),
        ("car-states", "mpc-nn", "shooting"),
    ],
)
def test_a_planner_holds_the_sequences_that_it_draws(task: str, name: str, planner: str) -> None:
    prefix = f"methods.{name}.{planner}"
    sets = [f"{prefix}.samples=300", f"{prefix}.horizon=11"]
    [cell] = cells(load_card(task), name, [0], sets=sets)
    [need] = [need for need in memory_needs(cell) if need.what == "action sequences of a plan"]
    size = cell.configuration.task.action.size
    assert need.bytes == np.zeros((300, 11, size), np.float32).nbytes
    assert need.settings == (f"{prefix}.samples", f"{prefix}.horizon")


def test_a_large_cell_is_estimated_by_its_size(store: Store) -> None:
    [cell] = cells(load_card("nav"), "solar", [0], sets=["evaluation.episodes=100000"])
    [found] = estimate(store, [Plan(cell, 100, Action.RUN, "why")])
    assert found.memory_bytes == sum(need.bytes for need in memory_needs(cell)) > WORKER_BYTES


def test_nothing_is_known_of_another_variant(
    store: Store, make_cells: Callable[..., list[Cell]]
) -> None:
    [seen], [other] = make_cells(1), make_cells(1, steps=5)
    assert seen.variant != other.variant
    computed(store, seen, 10, 20.0)
    [found] = estimate(store, [Plan(other, 100, Action.RUN, "why")])
    assert found == Estimate(None, WORKER_BYTES, None)
    assert measured_speeds(store, [seen, other]) == {
        (seen.task, seen.method, seen.variant): pytest.approx(2.0)
    }
