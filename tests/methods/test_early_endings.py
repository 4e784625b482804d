"""Local methods on a task whose episodes end early: they learn from what was lived, and go on."""

import numpy as np
import pytest
import torch
from bits import digest
from collected_episodes import collected_in
from method_runs import Run

from solar_cli.methods import solar
from solar_cli.methods.local import Lesson

both = pytest.mark.parametrize("name", ["solar", "vae", "rce"])
every = pytest.mark.parametrize("name", ["solar", "vae", "rce", "lqr-flm"])


class Ending:
    """Navigation that is over at a step of each episode's own; its last frames are ``rubbish``."""

    def __init__(self, task, rubbish: int) -> None:
        self._task, self._rubbish = task, rubbish

    def __getattr__(self, name):
        return getattr(self._task, name)

    def reset(self, streams):
        frames = self._task.reset(streams)
        self._step = 0
        self._lengths = 2 + (1000 * self._task.truth()[:, 0]).astype(int) % 5
        return frames

    def step(self, actions):
        over = self.ended()
        frames, costs = self._task.step(actions)
        self._step += 1
        frames[over] = self._rubbish
        return frames, np.where(over, 3.0, costs)

    def ended(self):
        return self._step >= self._lengths


def run(folder, name, rubbish=0, *sets):
    sets = ('update.reject="never"', *sets)
    return Run(folder, name, *sets, wrap=lambda task: Ending(task, rubbish)).iterate(1, 3)


@every
def test_episodes_end_early_and_learning_goes_on(tmp_path, name):
    done = run(tmp_path, name)
    lengths = np.concatenate([collected_in(i, done.environment).lengths for i in (1, 2, 3)])
    assert set(lengths.tolist()) == {2, 3, 4, 5, 6}
    assert all(np.isfinite(list(metrics.values())).all() for metrics in done.metrics)
    assert all(bool(torch.isfinite(part).all()) for part in done.learner.gains)


@both
@pytest.mark.parametrize("sets", [(), ("training.fine_tune_steps=4",)], ids=["fixed", "fine-tuned"])
def test_what_a_task_shows_after_the_end_does_not_matter(tmp_path, name, sets):
    sets = (*sets, 'cost_fit.per_time="chosen"')
    one, two = (run(tmp_path / str(grey), name, grey, *sets) for grey in (0, 200))
    assert one.metrics == two.metrics
    assert digest(one.learner.state_dict()) == digest(two.learner.state_dict())


def test_an_update_is_planned_for_what_was_lived(tmp_path, monkeypatch):
    """Episodes of 2 to 6 steps: gains are those of the half that lives longest, then they go on."""
    plans = []
    function = solar.improve_policy
    monkeypatch.setattr(
        solar,
        "improve_policy",
        lambda *given: plans.append((given, function(*given))) or plans[-1][1],
    )
    done = run(tmp_path, "solar")
    for iteration, ((previous, dynamics, _, bound, _), update) in enumerate(plans, start=1):
        region = done.learner.trust_region
        lengths = collected_in(iteration, done.environment).lengths
        steps = int(np.sort(lengths)[-2])
        assert len(previous.k) == len(dynamics.f) == len(update.policy.k) == steps
        assert bound <= 0.5 * steps * region.step.high
    gains, planned = done.learner.gains, plans[-1][1].policy
    reached = int(np.sort(lengths)[len(lengths) // 2])
    for part, known in zip(gains, planned, strict=True):
        assert torch.equal(part[:reached], known[:reached])
        assert all(torch.equal(later, known[reached - 1]) for later in part[reached:])


def test_states_reach_as_far_as_the_policy_that_is_built_upon(tmp_path):
    """Longer episodes of one that was taken back say nothing of what follows its own."""
    done = run(tmp_path, "solar")
    episodes = collected_in(1, done.environment)
    short, long = (episodes[np.isin(episodes.lengths, some)] for some in ((2, 3), (5, 6)))
    assert min(len(short), len(long)) > 1
    own, newest, older = done.learner.embedded(Lesson([short], [long], [[long]]))
    assert len(own.z) == len(short)
    assert len(newest.z) == len(short) + len(long)
    steps = int(np.sort(short.lengths)[-2])
    assert {part.live.shape[1] for part in (own, newest, *older)} == {steps}


@both
def test_the_best_that_collects_again_goes_on_from_what_was_reached(tmp_path, name):
    """On latents that have moved since it first acted, so that its gains are fitted anew."""
    sets = ("training.fine_tune_steps=4", "batches={ initial = 8, noisy = 5, noise_free = 3 }")
    done = Run(
        tmp_path,
        name,
        *sets,
        wrap=lambda task: Ending(task, 0),
        costs=lambda iteration, costs: costs + {2: -1.0, 3: 1e3}.get(iteration, 0.0),
    )
    collect, tried = done.environment.collect, []
    done.environment.collect = lambda policy, *rest, **more: (
        tried.append(policy.gains) or collect(policy, *rest, **more)
    )
    done.iterate(1, 3)
    assert [metrics["rejected"] for metrics in done.metrics] == [0.0, 0.0, 1.0]
    best, again = tried[2], tried[-1]
    lengths = collected_in(2, done.environment).lengths
    reached = int(np.sort(lengths)[len(lengths) // 2])
    assert 1 < reached < 6
    assert len(again.k) == len(best.k) == 6
    assert not torch.equal(again.K[reached - 1], best.K[reached - 1])
    assert not torch.equal(again.K[reached - 2], again.K[reached - 1])
    for part in again:
        assert all(torch.equal(later, part[reached - 1]) for later in part[reached:])


def test_what_steps_after_the_end_cost_counts_for_the_policy(tmp_path):
    done = run(tmp_path, "solar")
    best = done.learner.trust_region.best
    episodes = collected_in(best.iteration, done.environment)
    lived = np.where(episodes.live_steps, episodes.costs, 0.0).sum(axis=1)
    expected = (lived + 3.0 * (episodes.horizon - episodes.lengths)).mean()
    assert best.cost == pytest.approx(expected, rel=1e-12)
