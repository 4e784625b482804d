"""A diagnosis replaces what it says, and nothing else; what it computes is no result."""

import math
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from collected_episodes import collected_in
from predicted_costs import r2

from solar_cli.control import quadratic_cost
from solar_cli.control.trajectories import Trajectories
from solar_cli.envs import build_task
from solar_cli.envs.navigation import Navigation
from solar_cli.episodes import Episodes
from solar_cli.errors import UsageError
from solar_cli.experience import Environment, Experience
from solar_cli.experiment import privileged
from solar_cli.experiment.diagnosis import ALL, AS_IT_IS, diagnose, local_learner, parts
from solar_cli.experiment.privileged import ROLLOUTS, Part, World, of_positions, seen_whole
from solar_cli.experiment.session import Session
from solar_cli.methods import local, solar
from solar_cli.methods.local import Lesson
from solar_cli.settings import Cell, cells, load, load_card, method, method_names
from solar_cli.settings.local import CostFit
from solar_cli.settings.registry import BUILT_IN, settings_class
from solar_cli.store.owner import Owner
from solar_cli.store.store import Store
from solar_cli.streams import Streams

pytestmark = pytest.mark.filterwarnings("ignore:no representation of")
SMALL = ("training.steps=12", 'cost_fit.per_time="never"', "batches={ initial = 8, noisy = 6 }")
LOCAL = [e.name for e in BUILT_IN if issubclass(load(e.learner), local.LocalLearner)]


@pytest.fixture(autouse=True)
def as_in_a_worker() -> Iterator[None]:
    torch.use_deterministic_algorithms(True)
    yield
    torch.use_deterministic_algorithms(False)


def small(name: str = "solar", *sets: str) -> Cell:
    """The smoke variant of nav, made smaller still."""
    known = settings_class(method(name)).model_fields
    own = [f"methods.{name}.{text}" for text in SMALL if re.split("[.=]", text)[0] in known]
    return cells(load_card("nav"), name, [0], "smoke", ["task.horizon=6", *own, *sets])[0]


class Watched:
    """A privileged learner at work, with what its observer rolled out and what it fitted."""

    def __init__(
        self,
        folder: Path,
        monkeypatch: pytest.MonkeyPatch,
        cell: Cell,
        *given: Part,
        wrap: Callable[[Any], Any] = lambda task: task,
    ) -> None:
        task, configured = cell.configuration.task, cell.configuration.method
        simulator, other = wrap(build_task(task)), wrap(build_task(task))
        if Part.STATE in given:
            task, configured = of_positions(task, configured, 4)
            simulator, other = seen_whole(simulator), seen_whole(other)
        self.task, self.streams = task, Streams(0)
        self.environment = Environment(
            simulator, task, self.streams.under("environment"), folder / "-".join(given)
        )
        self.world = World(other, task, self.streams.under("observer"))
        kind = privileged.privileged(local_learner(cell.method), frozenset(given), self.world)
        self.learner: Any = kind(
            configured, task, self.streams.under("learner"), "cpu", lambda *_: None
        )
        self.observed: list[Episodes] = []
        self.updates: list[tuple[Any, ...]] = []
        rolled, improve = World.roll_out, solar.improve_policy

        def roll_out(world: World, *asked: Any) -> Episodes:
            self.observed.append(rolled(world, *asked))
            return self.observed[-1]

        def improve_policy(*asked: Any) -> Any:
            self.updates.append(asked)
            return improve(*asked)

        monkeypatch.setattr(World, "roll_out", roll_out)
        monkeypatch.setattr(solar, "improve_policy", improve_policy)

    def iterate(self, iterations: int) -> "Watched":
        for _ in range(iterations):
            self.observed.clear()
            self.environment.begin(self.environment.iteration + 1)
            self.learner.iterate(Experience(self.environment))
        return self

    def fresh(self, episodes: int) -> Trajectories:
        """Other episodes of the policy that collected the last batch, as control sees them."""
        policy = self.learner._tried[self.environment.iteration]
        world = World(self.world.task, self.task, Streams(1))
        rolled_out = World.roll_out(world, policy, episodes, 0)
        return self.learner.embedded(Lesson([rolled_out], [], [])).own


def test_as_it_is_gives_the_number_that_a_worker_stores(store: Store) -> None:
    cell = small()
    store.add([cell])
    number = store.claim(cell.hash, Owner.current(), 14, {})

    class Boss:
        stopping = False

        def tell(self, message: Any) -> None: ...

    Session(store, cell, number, 14, Boss(), device="cpu", checkpoint_seconds=1e9).run()
    rows = store.metrics(hashes=[cell.hash], names=["final_distance"], splits=["noise_free"])
    finding = next(diagnose(cell, 14, "cpu"))
    assert (finding.replaced, finding.episodes) == (AS_IT_IS, 14)
    assert finding.level == rows[-1]["value"]


def test_every_part_is_replaced_alone_and_then_all(monkeypatch: pytest.MonkeyPatch) -> None:
    given = []
    whole = privileged.privileged

    def spy(kind: Any, known: frozenset[Part], world: World) -> Any:
        given.append(known)
        return whole(kind, known, world)

    monkeypatch.setattr("solar_cli.experiment.diagnosis.privileged", spy)
    sets = ('evaluation.headline="return"', 'evaluation.better="higher"')
    findings = list(diagnose(small("solar", *sets), 14, "cpu"))
    assert [finding.replaced for finding in findings] == [AS_IT_IS, *Part, ALL]
    assert given == [set(), *({part} for part in Part), set(Part)]
    for finding in findings:
        assert finding.better_by == finding.level - findings[0].level
        assert finding.episodes == 14  # what the observer rolls out does not count
    lower = next(diagnose(small(), 14, "cpu"))
    assert lower.better_by == 0.0


def test_a_method_that_learns_no_representation_takes_true_positions_as_they_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = Watched(tmp_path, monkeypatch, small("lqr-flm"), Part.STATE).iterate(2)
    frames = collected_in(2, run.environment)
    assert frames.frames.shape[2:] == (4,)
    np.testing.assert_array_equal(run.learner.encode(frames), frames.frames)


@pytest.mark.parametrize("name", LOCAL)
def test_dynamics_are_plain_regression_on_the_observers_rollouts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    run = Watched(tmp_path, monkeypatch, small(name), Part.DYNAMICS).iterate(2)
    assert [len(batch) for batch in run.observed] == [6] * ROLLOUTS
    frames = Episodes.joined(run.observed)
    z = run.learner.representation.embed(frames).numpy()
    _, dynamics, cost, *_ = run.updates[-1]
    for t in range(6):
        design = np.column_stack([z[:, t], frames.actions[:, t], np.ones(len(z))])
        slopes = np.linalg.lstsq(design, z[:, t + 1], rcond=None)[0].T
        np.testing.assert_allclose(dynamics.F[t].numpy(), slopes[:, :-1], rtol=1e-6, atol=1e-8)
        np.testing.assert_allclose(dynamics.f[t].numpy(), slopes[:, -1], rtol=1e-6, atol=1e-8)
    first, second = (collected_in(iteration, run.environment) for iteration in (1, 2))
    states = run.learner.embedded(Lesson([second], [], [[first]]))
    own = local.LocalLearner.fitted_cost(run.learner, states.newest, states.older).model
    assert torch.equal(cost.C, own.C)  # of the counted batch


def test_the_cost_is_fitted_on_the_observers_rollouts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = Watched(tmp_path, monkeypatch, small(), Part.COST).iterate(2)
    _, dynamics, cost, *_ = run.updates[-1]
    rollouts = run.learner.embedded(Lesson(run.observed, [], [])).own
    settings = CostFit(width=privileged.OWN_STEP, terminal=3.0)
    again = quadratic_cost.fit_quadratic_cost(rollouts, [], 0.001, settings, 4).model
    assert torch.equal(cost.C, again.C)
    first, second = (collected_in(iteration, run.environment) for iteration in (1, 2))
    lesson = Lesson([second], [], [[first]])
    states = run.learner.embedded(lesson)
    own = local.LocalLearner.infer_dynamics(
        run.learner, states.newest, states.older, run.learner.latent_prior(lesson), run.streams
    )
    assert torch.equal(dynamics.F, own.model.F)  # of the counted batches


def test_representations_are_judged_by_the_methods_own_cost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = []
    for given in ((), (Part.COST, Part.DYNAMICS)):
        run = Watched(tmp_path, monkeypatch, small(), *given)
        run.environment.begin(1)
        found.append(run.learner.iterate(Experience(run.environment))["held_out_cost_r2"])
    assert found[0] == found[1]


def test_a_fit_of_its_own_step_knows_nothing_of_the_next() -> None:
    stream = np.random.default_rng(0)
    z = torch.as_tensor(stream.normal(size=(200, 5, 2)))
    factor = torch.tensor([1.0, 10.0, 1.0, 10.0], dtype=torch.float64)
    costs = factor * z[:, :-1].square().sum(dim=-1)
    nothing = torch.zeros(200, 4, 1, dtype=torch.float64)
    states = Trajectories.of(
        z, Episodes(np.empty((200, 5)), nothing.numpy(), nothing.numpy(), costs.numpy())
    )
    curvature = [
        quadratic_cost.fit_quadratic_cost(states, [], 0.0, CostFit(width=width), 2).model.C[
            :4, 0, 0
        ]
        for width in (privileged.OWN_STEP, 1.0)
    ]
    # But for the weak pull of every such fit towards the shared one.
    torch.testing.assert_close(curvature[0], 2 * factor, rtol=0.1, atol=0.0)
    assert (curvature[1] - 2 * factor).abs().min() > 0.5  # its neighbours pull


def test_with_the_true_state_no_network_sees_a_frame(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def seeing(*_: Any) -> Any:
        raise AssertionError("a network was used")

    monkeypatch.setattr(torch.nn.Conv2d, "forward", seeing)
    monkeypatch.setattr(torch.nn.Linear, "forward", seeing)
    with pytest.raises(AssertionError):
        Watched(tmp_path, monkeypatch, small()).iterate(1)
    run = Watched(tmp_path, monkeypatch, small(), Part.STATE).iterate(2)
    frames = collected_in(2, run.environment).frames
    assert frames.shape == (6, 7, 4)
    moved = np.diff(frames[..., :2], axis=1)
    np.testing.assert_allclose(moved, collected_in(2, run.environment).actions, atol=1e-6)
    assert run.observed == []


def test_the_true_state_is_whitened_and_holds_velocities(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cell = small("solar", "task.observation.window=2")
    run = Watched(tmp_path, monkeypatch, cell, Part.STATE).iterate(1)
    batch = collected_in(1, run.environment)
    z = run.learner.representation.embed(batch).numpy()
    assert z.shape == (8, 7, 8)
    np.testing.assert_allclose(np.cov(z[..., :4].reshape(-1, 4).T), np.eye(4), atol=1e-6)
    # The second block is nothing but the velocities of the first two frames, in units of their own.
    velocities = np.diff(batch.frames[..., :2], axis=1).reshape(-1, 2)
    block = z[:, 1:, 4:].reshape(-1, 4)
    fit = np.linalg.lstsq(velocities, block, rcond=None)[0]
    np.testing.assert_allclose(velocities @ fit, block, atol=1e-4)


def test_with_everything_known_the_model_is_the_simulator(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Navigation is linear and its cost quadratic, so that both fits have a closed form."""
    run = Watched(tmp_path, monkeypatch, small(), *Part).iterate(2)
    _, dynamics, cost, *_ = run.updates[-1]
    states = run.fresh(50)
    x = torch.cat([states.z[:, :-1], states.actions], dim=-1)
    predicted = torch.einsum("tij,ntj->nti", dynamics.F, x) + dynamics.f
    torch.testing.assert_close(predicted, states.z[:, 1:], rtol=0.0, atol=1e-5)
    assert r2(cost, states) > 0.999


class Ending:
    """A task that is over at a step of each episode's own: the second to the last."""

    def __init__(self, task: Any) -> None:
        self._task = task

    def __getattr__(self, name: str) -> Any:
        return getattr(self._task, name)

    def reset(self, streams: Any) -> Any:
        frames = self._task.reset(streams)
        self._step, self._last = 0, 2 + (1000 * self._task.truth()[:, 0]).astype(int) % 5
        return frames

    def step(self, actions: Any) -> Any:
        self._step += 1
        return self._task.step(actions)

    def ended(self) -> Any:
        return self._step >= self._last


@pytest.mark.parametrize("given", [{Part.DYNAMICS}, {Part.COST}, set(Part)])
def test_rollouts_of_episodes_that_end_early_are_of_the_steps_that_are_planned_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, given: set[Part]
) -> None:
    cell = small("solar", 'methods.solar.update.reject="never"')
    run = Watched(tmp_path, monkeypatch, cell, *given, wrap=Ending).iterate(3)
    assert {int(length) for batch in run.observed for length in batch.lengths} == {2, 3, 4, 5, 6}
    planned = []
    for iteration, (previous, dynamics, cost, *_) in enumerate(run.updates, start=1):
        lengths = np.sort(collected_in(iteration, run.environment).lengths)
        planned.append(int(lengths[-2]))
        assert len(previous.k) == len(dynamics.F) == planned[-1]
        assert len(cost.C) == planned[-1] + 1
    assert min(planned) < 6  # some batch has not lived as long as the rollouts


def test_what_is_rolled_out_is_the_policy_that_collected_though_training_went_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cell = small("solar", "methods.solar.training.fine_tune_steps=4")
    run = Watched(tmp_path, monkeypatch, cell, Part.DYNAMICS).iterate(3)
    # With the streams of the environment itself, the very episodes that counted.
    world = World(run.world.task, run.task, run.streams.under("environment"))
    for iteration, count in ((1, 8), (2, 6), (3, 6)):
        again = world.roll_out(run.learner._tried[iteration], count, iteration, 0)
        np.testing.assert_array_equal(
            again.actions, collected_in(iteration, run.environment).actions
        )


def test_rollouts_are_of_the_batch_that_is_built_upon(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = Watched(tmp_path, monkeypatch, small(), Part.DYNAMICS).iterate(1)
    first = Episodes.joined(run.observed)
    whole = run.learner.trust_region.judged
    monkeypatch.setattr(
        type(run.learner.trust_region),
        "judged",
        lambda region, tried, tolerance: whole(tried._replace(cost=math.inf), tolerance),
    )
    run.iterate(1)
    assert run.learner.trust_region.built_upon.iteration == 1
    np.testing.assert_array_equal(Episodes.joined(run.observed).actions, first.actions)


def test_a_task_without_true_positions_leaves_the_state_out(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert parts(small()) == list(Part)
    monkeypatch.setattr(Navigation, "truth_names", ())
    assert parts(small()) == [Part.DYNAMICS, Part.COST]


def test_a_run_that_diverges_is_a_finding_and_the_others_go_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    broken = small("solar", "methods.solar.training.learning_rate=1e30")
    findings = {finding.replaced: finding for finding in diagnose(broken, 8, "cpu")}
    assert math.isnan(findings[AS_IT_IS].level)
    assert "diverged in iteration 1" in findings[AS_IT_IS].notes[0]
    assert math.isfinite(findings[Part.STATE].level)
    assert math.isnan(findings[Part.STATE].better_by)


def test_nothing_is_left_on_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(Store, "open", None)
    next(diagnose(small(), 8, "cpu"))
    assert list(tmp_path.iterdir()) == []


def test_a_method_that_is_not_local_is_refused(make_cells: Callable[..., list[Cell]]) -> None:
    assert "fake" in method_names()
    with pytest.raises(UsageError, match=r"'fake' is not local.*solar or vae"):
        local_learner("fake")
