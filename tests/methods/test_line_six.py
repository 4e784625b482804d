"""LINEARIZEPOLICY within Algorithm 1: the encoder changes, the acting policy does not."""

import numpy as np
import pytest
import torch
from collected_episodes import collected_in
from method_runs import Run

from solar_cli.episodes import Batch, window_indices
from solar_cli.experience import Experience
from solar_cli.methods import solar
from solar_cli.methods.local import Lesson
from solar_cli.models.representation import Representation

EPISODES = "batches={ initial = 16, noisy = 16 }"


def acted(run, episodes) -> np.ndarray:
    """The means (N, T, a) of the learner's policy on recorded frames."""
    policy = run.learner.policy
    state, means = policy.start(len(episodes), None), []
    index = window_indices(episodes.horizon, episodes.window)
    for t in range(episodes.horizon):
        _, mean, state = policy.act(episodes.frames[:, index[t]], t, state)
        means.append(mean)
    return np.stack(means, axis=1)


def change(run, episodes) -> float:
    """How far the policy's means are from the recorded ones, in units of their spread."""
    recorded = episodes.action_means
    spread = recorded - recorded.mean(axis=0)
    assert spread.std() > 1e-4  # the policy looks at what it sees
    return float(
        np.sqrt(np.square(acted(run, episodes) - recorded).mean() / np.square(spread).mean())
    )


def before_the_update(tmp_path, linearise: str):
    """A run that has collected its third batch, and that batch."""
    sets = (EPISODES, 'update.reject="never"', f"update.linearise={linearise}")
    run = Run(tmp_path, "solar", *sets).iterate(1, 2)
    run.environment.begin(3)
    experience = Experience(run.environment)
    region = run.learner.collect_and_judge(experience)
    [batch] = run.learner.to_learn_from(experience, region).own
    return run, region, batch


def best_is_the_second(tmp_path, batches: str) -> Run:
    """Fine-tuned; the second policy gains much, the third one loses as much."""
    costs = {2: -1e3, 3: 1e3}
    return Run(
        tmp_path,
        "solar",
        batches,
        "training.steps=60",
        "training.fine_tune_steps=12",
        "training.fine_tune_rate=0.001",
        costs=lambda iteration, cost: cost + costs.get(iteration, 0.0),
    )


@pytest.mark.parametrize(("linearise", "preserved"), [("true", True), ("false", False)])
def test_a_changed_head_is_undone_by_line_six_alone(tmp_path, linearise, preserved):
    run, region, episodes = before_the_update(tmp_path, linearise)
    assert change(run, episodes) < 1e-3  # nothing has changed yet, but for batches of float32
    head = run.learner.representation._model.networks.mean[-1]
    rng = torch.Generator().manual_seed(0)
    mixing = torch.eye(4) + 0.5 * torch.randn(4, 4, generator=rng)
    with torch.no_grad():
        head.weight.copy_(mixing @ head.weight)
        head.bias.copy_(mixing @ head.bias + 0.1)
    run.learner.representation.moved_in = 3
    assert change(run, episodes) > 0.3
    states = run.learner.embedded(Lesson([episodes], [], [])).own
    run.learner.handed = run.learner.linearised(region, states).policy
    # The new latents are an affine map of the old ones, which a linear policy can undo.
    assert (change(run, episodes) < 0.01) == preserved
    if not preserved:
        assert change(run, episodes) > 0.3


def test_fine_tuning_preserves_the_acting_policy(tmp_path, monkeypatch):
    """A real training between collecting and updating; the policy to improve is looked at."""
    errors = {}
    for linearise in ("true", "false"):
        run = Run(
            tmp_path / linearise,
            "solar",
            "batches={ initial = 32, noisy = 32 }",
            f"update.linearise={linearise}",
            "training.steps=60",
            "training.fine_tune_steps=12",
            "training.fine_tune_rate=0.001",
        )
        run.iterate(1, 2)
        improved, improve = [], solar.improve_policy
        with monkeypatch.context() as patch:
            patch.setattr(solar, "improve_policy", lambda *a: improved.append(a[0]) or improve(*a))  # noqa: B023
            run.iterate(3, 3)
        assert run.learner.representation.moved_in == 3
        episodes = collected_in(run.learner.trust_region.current.iteration, run.environment)
        run.learner.handed = improved[0]
        errors[linearise] = change(run, episodes)
    # What is left is what no linear policy on the new latents does: the change is not affine.
    assert errors["true"] < 0.2
    assert errors["false"] > 10 * errors["true"]


def test_a_frozen_encoder_leaves_the_policy_as_it_is(tmp_path):
    run, region, episodes = before_the_update(tmp_path, "true")
    run.learner.representation.update(Experience(run.environment))
    assert run.learner.representation.moved_in == 1
    own = run.learner.embedded(Lesson([episodes], [], [])).own
    previous = run.learner.linearised(region, own)
    for left, right in zip(previous.policy, run.learner.gains, strict=True):
        assert torch.equal(left, right)


def test_going_back_to_a_policy_of_older_latents_preserves_it(tmp_path, monkeypatch):
    """The best policy acted before the last fine-tuning that held; the newest is taken back."""
    run = best_is_the_second(tmp_path, "batches={ initial = 32, noisy = 32 }").iterate(1, 2)
    improved, improve = [], solar.improve_policy
    monkeypatch.setattr(solar, "improve_policy", lambda *a: improved.append(a[0]) or improve(*a))
    alive = iter([True, False])  # before the training, and after it
    monkeypatch.setattr(Representation, "_alive", lambda *_: next(alive))
    run.iterate(3, 3)
    assert run.metrics[2]["rejected"] == run.metrics[2]["fine_tuning_taken_back"] == 1.0
    assert run.learner.trust_region.current.iteration == 2
    run.learner.gains = improved[0]
    assert change(run, collected_in(2, run.environment)) < 0.2


def test_the_best_policy_collects_again_on_the_latents_of_now(tmp_path):
    """It acted before the fine-tuning of its iteration; the next policy is worse."""
    batches = "batches={ initial = 32, noisy = 32, noise_free = 2 }"
    run = best_is_the_second(tmp_path, batches).iterate(1, 2)
    assert run.learner.representation.moved_in == 2
    best, again = Batch(2, 1), Batch(3, 1)
    run.environment.begin(3)
    experience, learner = Experience(run.environment), run.learner
    assert learner.collect_and_judge(experience).rejections
    learner.handed = learner._best_of_now(experience, learner.trust_region)
    assert change(run, run.environment.batch(best)) < 0.2
    assert change(run, run.environment.batch(again)) < 1e-3
