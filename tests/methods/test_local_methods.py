"""The rules around Algorithm 1's update, on the smoke variant of nav."""

import math

import numpy as np
import pytest
import torch
from collected_episodes import collected_in
from method_runs import Run

from solar_cli.control import trust_region
from solar_cli.envs import build_task
from solar_cli.episodes import Batch, Episodes, Evaluation, evaluate
from solar_cli.experience import Experience
from solar_cli.methods import Diverged, local, solar
from solar_cli.methods.local import Lesson
from solar_cli.streams import Streams

both = pytest.mark.parametrize("name", ["solar", "vae", "rce"])
every = pytest.mark.parametrize("name", ["solar", "vae", "rce", "lqr-flm"])


NOISE_FREE = "batches={ initial = 8, noisy = 5, noise_free = 3 }"


def spied(monkeypatch, name):
    """Arguments of every call of a function of Algorithm 1's page."""
    page = local if hasattr(local, name) else solar
    calls, function = [], getattr(page, name)

    def called(*given, **named):
        calls.append(given)
        return function(*given, **named)

    monkeypatch.setattr(page, name, called)
    return calls


def of_iteration(number, change):
    """Costs of one iteration are changed on their way to the learner."""
    return lambda iteration, costs: change(costs) if iteration == number else costs


# Handing over


@pytest.mark.parametrize("share", [-1.0, 1e9])
def test_an_update_that_promises_little_is_tried_before_it_is_handed_over(
    tmp_path, monkeypatch, share
):
    monkeypatch.setattr(trust_region, "LEAST_PROMISE", share)
    calls = spied(monkeypatch, "improve_policy")
    # Costs fall by a constant, so that something was gained.
    run = Run(tmp_path, "solar", costs=of_iteration(2, lambda costs: costs - 10.0)).iterate(1, 2)
    previous, newest = calls[-1][0], run.learner.gains
    expected = newest if share < 0 else previous
    for handed, part in zip(run.learner.policy.gains, expected, strict=True):
        assert torch.equal(handed, part)
    run.environment.begin(3)
    run.learner.collect_and_judge(Experience(run.environment))
    z = run.learner.embedded(Lesson([collected_in(3, run.environment)], [], [])).own
    means = torch.einsum("tij,ntj->nti", newest.K, z.z[:, :-1]) + newest.k
    torch.testing.assert_close(z.action_means, means)  # the newest is what is tried


@every
def test_noise_alone_is_no_promise_of_what_has_none(tmp_path, monkeypatch, name):
    """Two policies that differ in their noise alone are the same where none is drawn."""
    calls = spied(monkeypatch, "promised_fall")
    Run(tmp_path, name, NOISE_FREE).iterate(1, 1)
    previous, _, *model = calls[0]
    louder = previous._replace(S=4 * previous.S)
    assert trust_region.promised_fall(louder, previous, *model, noisy=True) > 0
    assert trust_region.promised_fall(louder, previous, *model, noisy=False) == 0


# Collecting


@every
def test_batches_are_those_of_the_card(tmp_path, name):
    run = Run(tmp_path, name, "batches={ initial = 7, noisy = 5 }").iterate(1, 3)
    assert [len(collected_in(i, run.environment)) for i in (1, 2, 3)] == [7, 5, 5]
    assert run.environment.episodes == 17


def test_the_first_batch_is_white_noise_of_the_cards_std(tmp_path):
    run = Run(tmp_path, "solar", "batches={ initial = 200, noisy = 4 }")
    run.environment.begin(1)
    run.learner.collect_and_judge(Experience(run.environment))
    first = collected_in(1, run.environment)
    assert not first.action_means.any()
    std = run.configuration.task.exploration.std
    count = first.actions.size
    assert first.actions.std() == pytest.approx(std, rel=5 / math.sqrt(2 * count))


def test_a_noise_free_batch_judges_the_policy(tmp_path):
    run = Run(tmp_path, "solar", "batches={ initial = 8, noisy = 4, noise_free = 3 }").iterate(1, 2)
    for iteration, noisy in ((1, 8), (2, 4)):
        episodes = collected_in(iteration, run.environment)
        assert len(episodes) == noisy + 3
        quiet, loud = episodes[:3], episodes[3:]
        np.testing.assert_array_equal(quiet.actions, quiet.action_means)
        assert not np.isclose(loud.actions, loud.action_means).any()
        region = run.learner.trust_region
        for anchor in {region.best.iteration: region.best, 2: region.current}.values():
            if anchor.iteration == iteration:
                assert anchor.cost == pytest.approx(quiet.costs.sum(axis=1).mean(), rel=1e-12)


# Going back to the best


def test_a_rejected_batch_goes_back_to_the_best_policy_and_is_learned_from(tmp_path, monkeypatch):
    dynamics, update = spied(monkeypatch, "infer_dynamics"), spied(monkeypatch, "improve_policy")
    run = Run(tmp_path, "solar", costs=of_iteration(2, lambda costs: costs + 1e3)).iterate(1, 2)
    metrics, region = run.metrics[1], run.learner.trust_region
    assert metrics["rejected"] == 1.0
    assert metrics["actual_improvement"] < -1e3
    assert region.best.iteration == region.current.iteration == 1
    assert metrics["step_multiplier"] < run.metrics[0]["step_multiplier"]
    first, second = (collected_in(i, run.environment) for i in (1, 2))
    newest, older = dynamics[1][:2]
    np.testing.assert_array_equal(newest.costs, Episodes.joined([first, second]).costs)
    assert not older
    for left, right in zip(update[1][0], update[0][0], strict=True):
        assert torch.equal(left, right)  # the policy that collected the first batch
    run.iterate(3, 3)
    assert run.metrics[2]["rejected"] == 0.0
    assert run.learner.trust_region.current.iteration == 3
    np.testing.assert_array_equal(dynamics[2][0].costs, collected_in(3, run.environment).costs)


def test_where_episodes_without_noise_reject_a_policy_the_best_collects_again(
    tmp_path, monkeypatch
):
    dynamics = spied(monkeypatch, "infer_dynamics")
    worse = {2: -1.0, 3: 1e3, 4: 1e3, 5: 1e3, 6: 1e3}
    costs = lambda iteration, costs: costs + worse.get(iteration, 0.0)  # noqa: E731
    run = Run(tmp_path, "solar", NOISE_FREE, costs=costs).iterate(1, 4)
    quiet = lambda iteration: Batch(iteration, 0, noisy=False)  # noqa: E731
    batch = lambda *names: Episodes.joined([run.environment.batch(name) for name in names])  # noqa: E731
    best = run.learner.trust_region.best.gains
    for iteration in (3, 4):
        again = batch(Batch(iteration, 1))
        z = run.learner.embedded(Lesson([again], [], [])).own
        means = torch.einsum("tij,ntj->nti", best.K, z.z[:, :-1]) + best.k
        torch.testing.assert_close(z.action_means, means)
        assert not np.allclose(batch(quiet(iteration)).action_means, again.action_means[:3])
    learned_from, older = dynamics[3][:2]
    of_the_best = (quiet(2), Batch(2, 1), Batch(3, 1), Batch(4, 1))
    expected = batch(*of_the_best, quiet(3), quiet(4))
    np.testing.assert_array_equal(learned_from.actions, expected.actions)
    np.testing.assert_array_equal(older[0].actions, batch(quiet(1), Batch(1, 1)).actions)
    assert len(older) == 1
    assert run.learner.trust_region.best.cost == batch(quiet(2)).costs.sum(axis=1).mean()
    run.iterate(5, 6)
    learned_from, older = dynamics[5][:2]  # the last four of the best, and two that were rejected
    of_the_best = (Batch(iteration, 1) for iteration in (3, 4, 5, 6))
    expected = batch(*of_the_best, quiet(5), quiet(6))
    np.testing.assert_array_equal(learned_from.actions, expected.actions)
    # What is left of iterations 3 and 4 has no noise, and says nothing of what actions do.
    np.testing.assert_array_equal(older[0].actions, batch(quiet(2), Batch(2, 1)).actions)
    run.iterate(7, 7)
    assert run.learner.trust_region.current.batches == (quiet(7), Batch(7, 1))


def test_without_rejection_the_newest_batch_is_built_upon(tmp_path):
    worse = of_iteration(2, lambda costs: costs + 1e3)
    run = Run(tmp_path, "solar", 'update.reject="never"', costs=worse).iterate(1, 2)
    region = run.learner.trust_region
    assert run.metrics[1]["rejected"] == 0.0
    assert (region.best.iteration, region.current.iteration) == (1, 2)


def test_older_batches_are_the_last_ones_newest_first(tmp_path, monkeypatch):
    dynamics = spied(monkeypatch, "infer_dynamics")
    run = Run(tmp_path, "solar", "local_fit.older_batches=2", 'update.reject="never"').iterate(1, 4)
    costs = {i: collected_in(i, run.environment).costs for i in (1, 2, 3, 4)}
    for iteration, expected in enumerate([[], [1], [2, 1], [3, 2]], 1):
        newest, older = dynamics[iteration - 1][:2]
        np.testing.assert_array_equal(newest.costs, costs[iteration])
        assert len(older) == len(expected)
        for batch, number in zip(older, expected, strict=True):
            np.testing.assert_array_equal(batch.costs, costs[number])


# Bounds


@every
def test_the_policys_std_stays_within_its_bounds(tmp_path, name):
    run = Run(
        tmp_path, name, "update.early_updates=1", "update.std_floor=[0.9, 0.5]",
        "update.std_ceiling=1.1", "update.kl_step=50.0",
    )  # fmt: skip
    std = run.configuration.task.exploration.std
    for iteration, floor in ((1, 0.9), (2, 0.5), (3, 0.5)):
        run.iterate(iteration, iteration)
        found = torch.linalg.eigvalsh(run.learner.gains.S).sqrt() / std
        assert float(found.min()) > floor - 1e-9
        assert float(found.max()) < 1.1 + 1e-9
    assert float(found.min()) < 0.9  # so the later floor is another one


@every
def test_the_kl_bound_is_kept_and_scaled_by_the_step(tmp_path, monkeypatch, name):
    calls = spied(monkeypatch, "improve_policy")
    run = Run(tmp_path, name, "update.kl_step=0.3").iterate(1, 3)
    bounds = [max_kl for _, _, _, max_kl, _ in calls]
    multipliers = [metrics["step_multiplier"] for metrics in run.metrics]
    assert bounds == pytest.approx([0.3 * 6 * multiplier for multiplier in multipliers])
    assert len(set(multipliers)) > 1
    for metrics, bound in zip(run.metrics, bounds, strict=True):
        assert 0 < metrics["policy_kl"] <= bound * (1 + 1e-9)


def test_without_a_kl_bound_the_update_is_the_unconstrained_one(tmp_path, monkeypatch):
    calls = spied(monkeypatch, "improve_policy")
    Run(tmp_path, "solar", 'update.kl_step="unbounded"').iterate(1, 1)
    assert calls[0][3] is None


# What is not finite


@every
@pytest.mark.parametrize("value", [math.nan, math.inf])
@pytest.mark.parametrize("iteration", [1, 2])
@pytest.mark.parametrize("noisy", [False, True])
def test_a_cost_that_is_not_finite_is_divergence(tmp_path, name, value, iteration, noisy):
    """Of three episodes without noise that judge, or of the five others."""
    broken = of_iteration(
        iteration, lambda costs: costs * (value if (len(costs) > 3) == noisy else 1)
    )
    run = Run(tmp_path, name, NOISE_FREE, costs=broken).iterate(1, iteration - 1)
    with pytest.raises(Diverged, match=f"iteration {iteration}"):
        run.iterate(iteration, iteration)


def test_a_policy_that_is_not_finite_is_divergence(tmp_path, monkeypatch):
    improve = solar.improve_policy

    def broken(*given):
        update = improve(*given)
        return update._replace(policy=update.policy._replace(k=update.policy.k * math.nan))

    monkeypatch.setattr(solar, "improve_policy", broken)
    with pytest.raises(Diverged, match="policy"):
        Run(tmp_path, "solar").iterate(1, 1)


# What the methods are


def test_only_solar_has_a_factor_over_dynamics(tmp_path):
    solar_run = Run(tmp_path / "solar", "solar").iterate(1, 1)
    vae_run = Run(tmp_path / "vae", "vae").iterate(1, 1)
    rce_run = Run(tmp_path / "rce", "rce").iterate(1, 1)
    for run, known in ((solar_run, True), (vae_run, False), (rce_run, False)):
        for own in (True, False):
            older = [collected_in(1, run.environment)]
            prior = run.learner.representation.dynamics_prior(older, as_it_stands=own)
            assert (prior.factor is not None) == known
            assert (prior.transition is not None) == (run is rce_run)
    assert "kl_dynamics" in solar_run.metrics[0]
    assert "kl_dynamics" not in vae_run.metrics[0]
    assert vae_run.learner.settings.local_fit.method == "gmm"
    assert rce_run.learner.settings.local_fit.method == "network"


def test_time_varying_factors_have_one_a_time_step(tmp_path):
    run = Run(tmp_path, "solar", 'dynamics.factors="varying"').iterate(1, 1)
    prior = run.learner.representation.dynamics_prior([], as_it_stands=True)
    assert prior.factor.n.shape == (6,)


@both
def test_metrics_are_named_finite_numbers(tmp_path, name):
    run = Run(tmp_path, name).iterate(1, 2)
    for metrics in run.metrics:
        for key, value in metrics.items():
            assert isinstance(value, float), key
            assert math.isfinite(value), key
    # What the issue asks to be watched.
    watched = {"held_out_elbo", "active_latents", "one_step_r2", "cost_r2", "policy_kl"}
    watched |= {"policy_std", "predicted_improvement", "actual_improvement", "rejected"}
    assert watched <= set(run.metrics[1])


# Checks of the task


@every
def test_checks_of_the_task_are_stored_and_change_nothing(tmp_path, monkeypatch, name):
    run = Run(tmp_path / "with", name).iterate(1, 2)
    for metrics in run.metrics:
        assert {"last_action_p_value", "action_seen_late", "stuck"} <= set(metrics)
    monkeypatch.setattr(local, "task_metrics", lambda *_: {})
    assert Run(tmp_path / "without", name).iterate(1, 2).bits() == run.bits()


def test_what_is_built_upon_and_older_batches_are_checked(tmp_path, monkeypatch):
    calls = spied(monkeypatch, "task_metrics")
    run = Run(tmp_path, "solar", costs=of_iteration(2, lambda costs: costs - 1e3)).iterate(1, 2)
    newest, older, *rest = calls[1]
    first, second = (collected_in(i, run.environment) for i in (1, 2))
    np.testing.assert_array_equal(newest.costs, second.costs)
    np.testing.assert_array_equal(older[0].costs, first.costs)
    task = run.configuration.task
    assert rest == [4, task.action_cost, task.action.bound]


# Diagnosing


def test_diagnosis_is_of_the_newest_latents(tmp_path, monkeypatch):
    run = Run(tmp_path, "solar")
    task = run.configuration.task
    evaluation = evaluate(build_task(task), task, run.learner.policy, 20, Streams(5))
    assert run.learner.diagnose(evaluation) == {}
    assert run.learner.reconstruct(evaluation.episodes) is None
    assert run.learner.encode(evaluation.episodes) is None
    run.iterate(1, 1)
    truth = torch.from_numpy(evaluation.truth)
    mixing = torch.as_tensor(np.random.default_rng(0).normal(size=(4, 4)))
    states = torch.cat([truth @ mixing + 3.0, torch.zeros_like(truth)], dim=-1)
    monkeypatch.setattr(run.learner.representation, "embed", lambda _: states)
    found = run.learner.diagnose(evaluation)
    names = [f"truth_r2_{name}" for name in ("x", "y", "goal_x", "goal_y")]
    assert list(found) == names + [f"latent_r2_{i}" for i in range(4)]
    assert min(found.values()) > 1 - 1e-9


def test_without_truth_there_is_no_diagnosis(tmp_path):
    run = Run(tmp_path, "solar").iterate(1, 1)
    episodes = collected_in(1, run.environment)
    blind = Evaluation(episodes, {}, np.empty((len(episodes), 7, 0)))
    assert run.learner.diagnose(blind) == {}


@both
def test_a_trained_method_shows_what_it_sees(tmp_path, name):
    run = Run(tmp_path, name).iterate(1, 1)
    episodes = collected_in(1, run.environment)
    found = run.learner.reconstruct(episodes[:2])
    assert found.shape == episodes.frames[:2].shape
    assert found.dtype == np.uint8
    latents = run.learner.encode(episodes[:2])
    seen, _ = run.learner.representation.follow(episodes.frames[1, 3][None], 3, None, None)
    one = seen[0].numpy()
    assert latents.shape == (2, 7, 4)
    np.testing.assert_allclose(latents[1, 3], one, atol=1e-5)
