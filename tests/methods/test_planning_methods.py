"""MPC-NN and the global-model ablation: what is SOLAR's in them, how they stop, what they plan."""

import numpy as np
import pytest
import torch
from bits import digest
from method_runs import Run

from solar_cli.envs import build_task
from solar_cli.episodes import evaluate
from solar_cli.errors import UsageError
from solar_cli.experience import Experience
from solar_cli.pulse import Diverged
from solar_cli.streams import Streams

FINE_TUNED = ("training.fine_tune_steps=8", "training.fine_tune_rate=0.003")


# The representation


def test_the_representation_is_solars_own(tmp_path):
    """Of the same episodes, by the same training, with the same bits."""
    ours = Run(tmp_path / "ours", "global-mpc").iterate(1, 1)
    solar = Run(tmp_path / "solar", "solar").iterate(1, 1)
    states = [one.learner.representation.state_dict() for one in (ours, solar)]
    assert digest(states[0]) == digest(states[1])
    for name in ("held_out_elbo", "held_out_cost_r2", "alive"):
        assert ours.metrics[0][name] == solar.metrics[0][name], name


def test_states_are_embedded_anew_when_the_representation_has_moved(tmp_path):
    """All batches that networks are fitted to are of the same latent space."""
    moving = Run(tmp_path, "global-mpc", *FINE_TUNED).iterate(1, 2)
    assert moving.learner.representation.moved_in == 2
    experience = Experience(moving.environment)
    seen = moving.learner._embedded(experience)
    for name, batch in zip(experience.batches(), seen, strict=True):
        expected = moving.learner.representation.embed(experience.batch(name)).float()
        torch.testing.assert_close(batch.states, expected, rtol=0, atol=0)


# Stopping


@pytest.mark.parametrize("name", ["global-mpc", "mpc-nn"])
def test_a_restored_learner_acts_as_the_one_that_was_saved(tmp_path, name):
    whole = Run(tmp_path, name).iterate(1, 2)
    restored = Run(tmp_path, name).restore(whole.state())
    task, settings = build_task(whole.configuration.task), whole.configuration.task
    actions = [
        evaluate(task, settings, one.learner.policy, 3, Streams(5)).episodes.actions
        for one in (whole, restored)
    ]
    np.testing.assert_array_equal(*actions)


@pytest.mark.parametrize("name", ["global-mpc", "mpc-nn"])
def test_what_is_no_number_ends_as_diverged(tmp_path, name):
    def spoilt(task):
        step = task.step

        def stepping(actions):
            frames, costs = step(actions)
            frames = np.full_like(frames, np.nan) if frames.dtype.kind == "f" else frames
            return frames, costs * np.nan

        task.step = stepping
        return task

    with pytest.raises(Diverged):
        Run(tmp_path, name, wrap=spoilt).iterate(1, 1)


# What is planned with


def test_metrics_say_how_good_the_models_are(tmp_path):
    for name, costs in (("global-mpc", True), ("mpc-nn", False)):
        metrics = Run(tmp_path / name, name).iterate(1, 1).metrics[0]
        assert {"one_step_r2", "horizon_r2"} <= set(metrics)
        assert ("cost_r2" in metrics) is costs


def test_before_the_first_iteration_nothing_is_planned(tmp_path):
    for name in ("global-mpc", "mpc-nn"):
        one = Run(tmp_path / name, name)
        task = one.configuration.task
        judged = evaluate(build_task(task), task, one.learner.policy, 2, Streams(0))
        assert not judged.episodes.actions.any()


def test_a_bias_is_where_plans_begin(tmp_path):
    """With next to no deviation a plan stays there, over the bound of an action."""
    sets = ("planner.mean=[0.25, -0.5]", "planner.std=1e-9", "planner.least_std=0.0")
    one = Run(tmp_path, "global-mpc", *sets).iterate(1, 1)
    task = one.configuration.task
    judged = evaluate(build_task(task), task, one.learner.policy, 2, Streams(0))
    np.testing.assert_allclose(judged.episodes.actions[..., 0], 0.25 * task.action.bound, atol=1e-6)
    np.testing.assert_allclose(judged.episodes.actions[..., 1], -0.5 * task.action.bound, atol=1e-6)


def test_a_bias_of_another_length_is_refused(tmp_path):
    with pytest.raises(UsageError, match=r"planner\.mean = .*2 entries"):
        Run(tmp_path, "global-mpc", "planner.mean=[0.1]")


def test_known_dynamics_are_driven_to_the_target(tmp_path):
    """Random shooting through a perfect model: the planner, apart from what is learned."""
    one = Run(tmp_path, "mpc-nn", "shooting.samples=256", "shooting.horizon=8").iterate(1, 1)
    learner, task = one.learner, one.configuration.task.model_copy(update={"horizon": 80})
    learner.task = task
    learner.model.dynamics.forward = car_dynamics
    judged = evaluate(build_task(task), task, learner.policy, 2, Streams(0))
    assert judged.measures["distance"][:, 0].min() > 4.0
    assert judged.measures["distance"][:, -1].max() < 1.0


def car_dynamics(states: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
    """E.2's numbers (x, y, cos, sin of the heading, v, cos, sin of the steering, target)."""
    x, y, cos, sin, v, steer_cos, steer_sin, gx, gy = states.T
    theta, phi = torch.atan2(sin, cos), torch.atan2(steer_sin, steer_cos)
    v = (v + 0.1 * actions[:, 0]).clamp(-1, 1)
    phi = (phi + 0.1 * actions[:, 1]).clamp(-np.pi / 4, np.pi / 4)
    x = (x + 0.1 * v * theta.cos()).clamp(-2.3, 2.3)
    y = (y + 0.1 * v * theta.sin()).clamp(-2.3, 2.3)
    theta = theta + 0.1 * v * phi.tan()
    parts = [x, y, theta.cos(), theta.sin(), v, phi.cos(), phi.sin(), gx, gy]
    return torch.stack(parts, dim=1)
