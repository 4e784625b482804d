"""The pixel-space model as a method: its plans, what it learns from, what it shows."""

import numpy as np
import pytest
import torch
from bits import digest
from collected_episodes import collected_in
from method_runs import Run

from solar_cli.control.planning_policy import PlanningPolicy
from solar_cli.envs import build_task
from solar_cli.episodes import Evaluation, evaluate
from solar_cli.methods import Diverged, Foreseeing
from solar_cli.methods.pixel_mpc import PixelPlanner
from solar_cli.models import video_training
from solar_cli.models.video import Step, VideoModel
from solar_cli.streams import Streams

NAME = "pixel-mpc"
SMALL = (
    "initial=6",
    "episodes=3",
    "training={ steps = 12, later_steps = 8, clips = 4 }",
    "planner={ horizon = 4, samples = 8, iterations = 2, elites = 3 }",
)


@pytest.fixture(autouse=True)
def short_pulses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(video_training, "PULSE_STEPS", 4)


def run(folder, *sets, **more) -> Run:
    return Run(folder, NAME, *SMALL, *sets, **more)


# Planning


class Aiming(VideoModel):
    """Costs of a step are the squared distance of its action to ``aim``, doubled at each step."""

    aim = torch.tensor([0.15, -0.1])

    def rollout(self, window, actions):
        for h in range(actions.shape[2]):
            cost = 2.0**h * (actions[:, :, h] - self.aim).square().sum(dim=-1)
            yield Step(torch.empty(0), cost.flatten())


def planner(tmp_path, *sets, model=Aiming) -> PixelPlanner:
    one = run(tmp_path, *sets)
    settings, task = one.configuration.method, one.configuration.task
    return PixelPlanner(settings, task, model(settings.video, task), Streams(0))


def seen(count: int) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 255, (count, 1, 2, 32, 32), dtype=np.uint8)


@pytest.mark.parametrize("repeat", [1, 3])
def test_a_plan_finds_the_actions_that_cost_least(tmp_path, repeat):
    search = (
        f"planner={{ horizon = 5, repeat = {repeat}, samples = 300, iterations = 8, elites = 20 }}"
    )
    one = planner(tmp_path, search)
    policy = PlanningPolicy(one.see, one, 0.0, 0.0, one.task)
    wanted, means, state = policy.act(seen(4), 0, policy.start(4, None))
    np.testing.assert_array_equal(wanted, means)
    np.testing.assert_allclose(means, np.tile(Aiming.aim.numpy(), (4, 1)), atol=0.01)
    assert state.plan.shape == (4, {1: 5, 3: 2}[repeat], 2)


def test_an_action_pays_what_it_is_known_to_cost(tmp_path):
    one = planner(tmp_path)
    actions = torch.randn(3, 8, 4, 2)
    window = torch.zeros(3, 1, *one.model.shape)
    free = one.forecast(window, actions)
    one.task = one.task.model_copy(update={"action_cost": 0.7})
    paid = one.forecast(window, actions)
    known = actions.square().sum(dim=(2, 3))
    torch.testing.assert_close(paid - free, (0.7 - 0.001) * known, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("repeat", [1, 2, 3])
def test_a_plan_a_step_later_is_the_mean_of_what_it_held(tmp_path, repeat):
    one = planner(tmp_path, f"planner.repeat={repeat}", "planner.horizon=6")
    plan = torch.randn(2, one.actions, 2)
    held = plan.repeat_interleave(repeat, dim=1)
    moved = torch.cat([held[:, 1:], held[:, -1:]], dim=1)
    expected = moved.unflatten(1, (one.actions, repeat)).mean(dim=2)
    torch.testing.assert_close(one.later(plan), expected)


def test_a_plan_does_not_depend_on_the_episodes_beside_it(tmp_path):
    done = run(tmp_path).iterate(1, 1)
    policy, frames = done.learner.policy, seen(70)
    together = policy.act(frames, 3, policy.start(70, None))[0]
    alone = policy.act(frames[:2], 3, policy.start(2, None))[0]
    np.testing.assert_allclose(together[:2], alone, atol=1e-4)


def test_what_is_not_finite_is_not_chosen(tmp_path):
    class Broken(Aiming):
        def rollout(self, window, actions):
            for step in super().rollout(window, actions):
                odd = torch.arange(len(step.cost)) % 2 == 1
                yield step._replace(cost=torch.where(odd, torch.nan, step.cost))

    forecast = planner(tmp_path, model=Broken).forecast(
        torch.zeros(1, 1, 2, 16, 16), torch.zeros(1, 6, 4, 2)
    )
    assert torch.isposinf(forecast[0, 1::2]).all()
    assert torch.isfinite(forecast[0, ::2]).all()


# Learning


def test_it_begins_with_exploration_and_goes_on_with_plans_and_noise(tmp_path):
    done = run(tmp_path).iterate(1, 2)
    first, second = (collected_in(i, done.environment) for i in (1, 2))
    assert (len(first), len(second)) == (6, 3)
    assert not first.action_means.any()
    assert np.abs(second.action_means).max() > 1e-3
    noise = second.actions - second.action_means
    assert noise.std() == pytest.approx(0.1, rel=0.5)
    assert set(done.metrics[1]) == {"loss_frames", "loss_costs"}


def test_a_run_interrupted_at_any_pulse_ends_with_the_same_bits(tmp_path):
    saved = []
    whole = run(
        tmp_path, pulse=lambda *_: saved.append((whole.environment.iteration, whole.state()))
    )
    whole.iterate(1, 3)
    assert len(saved) == 3 + 2 + 2
    for iteration, state in saved:
        resumed = run(tmp_path).restore(state).iterate(iteration, 3)
        assert repr(resumed.metrics) == repr(whole.metrics[iteration - 1 :])
        assert resumed.bits() == whole.bits()


def test_a_run_interrupted_between_iterations_or_while_it_collects_ends_with_the_same_bits(
    tmp_path,
):
    saved = []

    def saving(iteration, costs):
        saved.append((iteration, whole.state()))
        return costs

    whole = run(tmp_path, costs=saving)
    whole.iterate(1, 2)
    for iteration, state in saved[::3]:
        resumed = run(tmp_path).restore(state).iterate(iteration, 2)
        assert repr(resumed.metrics) == repr(whole.metrics[iteration - 1 :])
        assert resumed.bits() == whole.bits()


def test_a_cell_has_its_bits(tmp_path):
    runs = [run(tmp_path / str(i), seed=i // 2).iterate(1, 2) for i in range(3)]
    assert runs[0].bits() == runs[1].bits()
    assert runs[2].bits() != runs[0].bits()


def test_a_cost_that_is_not_finite_is_a_divergence(tmp_path):
    with pytest.raises(Diverged, match="iteration 1"):
        run(tmp_path, costs=lambda _, costs: costs * np.nan).iterate(1, 1)


# What it shows


def test_it_says_how_well_it_predicts_and_shows_it(tmp_path):
    one = run(tmp_path)
    task = one.configuration.task
    evaluation = evaluate(build_task(task), task, one.learner.policy, 5, Streams(5))
    episodes = evaluation.episodes
    assert isinstance(one.learner, Foreseeing)
    assert one.learner.diagnose(evaluation) == {}
    assert one.learner.foresee(episodes) is None
    one.iterate(1, 1)
    before = one.bits()
    found = one.learner.diagnose(evaluation)
    assert list(found) == ["one_step_frame_error", "horizon_frame_error", "cost_r2"]
    assert np.isfinite(list(found.values())).all()
    ahead = one.learner.foresee(episodes)
    assert ahead.shape == (5, 4, *episodes.frames.shape[2:])
    assert ahead.dtype == np.uint8
    assert one.bits() == before


def test_a_model_that_copies_shows_copies_and_has_their_error(tmp_path):
    one = run(tmp_path).iterate(1, 1)
    model = one.learner.model
    torch.nn.init.zeros_(model.motion[-1].weight)
    torch.nn.init.zeros_(model.motion[-1].bias)
    episodes = collected_in(1, one.environment)
    ahead = one.learner.foresee(episodes)
    first = model.as_frames(model.scaled(model.pooled(torch.from_numpy(episodes.frames[:, 0]))))
    for h in range(4):
        np.testing.assert_allclose(ahead[:, h].astype(int), first.numpy(), atol=1)
    judged = Evaluation(episodes, {}, np.empty((len(episodes), 7, 0)))
    found = one.learner.diagnose(judged)
    assert found["one_step_frame_error"] == pytest.approx(1.0)
    assert found["horizon_frame_error"] == pytest.approx(1.0)


def test_what_a_task_shows_after_the_end_does_not_matter(tmp_path):
    class Ending:
        def __init__(self, task, rubbish):
            self._task, self._rubbish = task, rubbish

        def __getattr__(self, name):
            return getattr(self._task, name)

        def reset(self, streams):
            self._step = 0
            self._lengths = 2 + np.arange(len(streams)) % 5
            return self._task.reset(streams)

        def step(self, actions):
            over = self.ended()
            frames, costs = self._task.step(actions)
            self._step += 1
            frames[over] = self._rubbish
            return frames, np.where(over, 3.0 * self._rubbish, costs)

        def ended(self):
            return self._step >= self._lengths

    def ended(rubbish):
        return run(tmp_path / str(rubbish), wrap=lambda task: Ending(task, rubbish)).iterate(1, 2)

    one, two = ended(0), ended(200)
    assert set(collected_in(1, one.environment).lengths.tolist()) == {2, 3, 4, 5, 6}
    assert one.metrics == two.metrics
    assert digest(one.learner.state_dict()) == digest(two.learner.state_dict())
