"""The rules around Algorithm 1's update, on the smoke variant of nav."""

import math

import numpy as np
import pytest
import torch
from method_runs import Run

from solar_cli.envs import build_task
from solar_cli.episodes import Evaluation, evaluate
from solar_cli.methods import Diverged, solar
from solar_cli.streams import Streams

both = pytest.mark.parametrize("name", ["solar", "vae"])


def spied(monkeypatch, name):
    """Arguments of every call of a function of Algorithm 1's page."""
    calls, function = [], getattr(solar, name)
    monkeypatch.setattr(solar, name, lambda *given: calls.append(given) or function(*given))
    return calls


def of_iteration(number, change):
    """Costs of one iteration are changed on their way to the learner."""
    return lambda iteration, costs: change(costs) if iteration == number else costs


# Collecting


@both
def test_batches_are_those_of_the_card(tmp_path, name):
    run = Run(tmp_path, name, "batches={ initial = 7, noisy = 5 }").iterate(1, 3)
    sizes = [[len(b) for b in run.environment.collected(i)] for i in (1, 2, 3)]
    assert sizes == [[7], [5], [5]]
    assert run.environment.episodes == 17


def test_the_first_batch_is_white_noise_of_the_cards_std(tmp_path):
    run = Run(tmp_path, "solar", "batches={ initial = 200, noisy = 4 }")
    run.environment.begin(1)
    run.learner.collect(run.environment)
    [first] = run.environment.collected(1)
    assert not first.action_means.any()
    std = run.configuration.task.exploration.std
    count = first.actions.size
    assert first.actions.std() == pytest.approx(std, rel=5 / math.sqrt(2 * count))


def test_a_noise_free_batch_judges_the_policy(tmp_path):
    run = Run(tmp_path, "solar", "batches={ initial = 8, noisy = 4, noise_free = 3 }").iterate(1, 2)
    assert [len(batch) for batch in run.environment.collected(1)] == [8]
    noisy, quiet = run.environment.collected(2)
    assert (len(noisy), len(quiet)) == (4, 3)
    np.testing.assert_array_equal(quiet.actions, quiet.action_means)
    run.environment.begin(2)
    run.learner.load_state_dict(run.state()["learner"])
    region = run.learner.trust_region
    judged = [anchor for anchor in (region.best, region.current) if anchor.iteration == 2]
    for anchor in judged:
        assert anchor.cost == pytest.approx(quiet.costs.sum(axis=1).mean(), rel=1e-12)


# Going back to the best


def test_a_rejected_batch_goes_back_to_the_best_policy_and_its_data(tmp_path, monkeypatch):
    dynamics, update = spied(monkeypatch, "infer_dynamics"), spied(monkeypatch, "improve_policy")
    run = Run(tmp_path, "solar", costs=of_iteration(2, lambda costs: costs + 1e3)).iterate(1, 2)
    metrics, region = run.metrics[1], run.learner.trust_region
    assert metrics["rejected"] == 1.0
    assert metrics["actual_improvement"] < -1e3
    assert region.best.iteration == region.current.iteration == 1
    assert metrics["step_multiplier"] < run.metrics[0]["step_multiplier"]
    [first], [second] = (run.environment.collected(i) for i in (1, 2))
    newest, older = dynamics[1][:2]
    np.testing.assert_array_equal(newest.costs, first.costs)
    np.testing.assert_array_equal(older[0].costs, second.costs)
    for left, right in zip(update[1][0], update[0][0], strict=True):
        assert torch.equal(left, right)  # the policy that collected the first batch
    run.iterate(3, 3)
    assert run.metrics[2]["rejected"] == 0.0
    assert run.learner.trust_region.current.iteration == 3
    np.testing.assert_array_equal(
        dynamics[2][0].costs, np.concatenate([b.costs for b in run.environment.collected(3)])
    )


def test_without_rejection_the_newest_batch_is_built_upon(tmp_path):
    worse = of_iteration(2, lambda costs: costs + 1e3)
    run = Run(tmp_path, "solar", 'update.reject="never"', costs=worse).iterate(1, 2)
    region = run.learner.trust_region
    assert run.metrics[1]["rejected"] == 0.0
    assert (region.best.iteration, region.current.iteration) == (1, 2)


def test_older_batches_are_the_last_ones_newest_first(tmp_path, monkeypatch):
    dynamics = spied(monkeypatch, "infer_dynamics")
    run = Run(tmp_path, "solar", "local_fit.older_batches=2", 'update.reject="never"').iterate(1, 4)
    costs = {i: run.environment.collected(i)[0].costs for i in (1, 2, 3, 4)}
    for iteration, expected in enumerate([[], [1], [2, 1], [3, 2]], 1):
        newest, older = dynamics[iteration - 1][:2]
        np.testing.assert_array_equal(newest.costs, costs[iteration])
        assert len(older) == len(expected)
        for batch, number in zip(older, expected, strict=True):
            np.testing.assert_array_equal(batch.costs, costs[number])


# Bounds


@both
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


@both
def test_the_kl_bound_is_kept_and_scaled_by_the_step(tmp_path, name):
    run = Run(tmp_path, name, "update.kl_step=0.3").iterate(1, 3)
    for metrics in run.metrics:
        assert metrics["kl"] <= 0.3 * 6 * metrics["step_multiplier"] * (1 + 1e-9)
        assert metrics["kl"] > 0


def test_without_a_kl_bound_the_update_is_the_unconstrained_one(tmp_path, monkeypatch):
    calls = spied(monkeypatch, "improve_policy")
    Run(tmp_path, "solar", 'update.kl_step="unbounded"').iterate(1, 1)
    assert calls[0][3] is None


# What is not finite


@both
@pytest.mark.parametrize("value", [math.nan, math.inf])
@pytest.mark.parametrize("iteration", [1, 2])
def test_a_cost_that_is_not_finite_is_divergence(tmp_path, name, value, iteration):
    broken = of_iteration(iteration, lambda costs: costs * value)
    run = Run(tmp_path, name, costs=broken).iterate(1, iteration - 1)
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
    assert solar_run.learner.representation.dynamics_prior.factor is not None
    assert vae_run.learner.representation.dynamics_prior.factor is None
    assert "kl_dynamics" in solar_run.metrics[0]
    assert "kl_dynamics" not in vae_run.metrics[0]
    assert vae_run.learner.settings.local_fit.method == "gmm"


def test_time_varying_factors_have_one_a_time_step(tmp_path):
    run = Run(tmp_path, "solar", 'dynamics.factors="varying"').iterate(1, 1)
    assert run.learner.representation.dynamics_prior.factor.n.shape == (6,)


@both
def test_metrics_are_named_finite_numbers(tmp_path, name):
    run = Run(tmp_path, name).iterate(1, 2)
    unknown = {"predicted_improvement", "actual_improvement"}  # before there was an update
    for iteration, metrics in enumerate(run.metrics):
        for key, value in metrics.items():
            assert isinstance(value, float), key
            assert math.isfinite(value) or (iteration == 0 and key in unknown), key
    watched = {"active_latents", "cost_r2", "kl", "policy_std", "rejected", "held_out_loss"}
    assert watched <= set(run.metrics[1])


# Diagnosing


def test_diagnosis_says_what_linear_maps_explain(tmp_path, monkeypatch):
    run = Run(tmp_path, "solar")
    task = run.configuration.task
    evaluation = evaluate(build_task(task), task, run.learner.policy, 200, Streams(5))
    assert run.learner.diagnose(evaluation) == {}
    assert run.learner.reconstruct(evaluation.episodes) is None
    run.iterate(1, 1)
    truth = torch.from_numpy(evaluation.truth)
    rng = np.random.default_rng(0)
    mixing = torch.as_tensor(rng.normal(size=(4, 4)))
    representation = run.learner.representation
    monkeypatch.setattr(representation, "embed", lambda _: truth @ mixing + 3.0)
    found = run.learner.diagnose(evaluation)
    assert len(found) == 8
    assert min(found.values()) > 1 - 1e-9
    # Latents that know x alone: x and what is x again are explained, the goal is not.
    noise = torch.as_tensor(rng.normal(size=truth.shape))
    latents = torch.cat([truth[..., :1], 2 * truth[..., :1], noise[..., :2]], dim=-1)
    monkeypatch.setattr(representation, "embed", lambda _: latents)
    found = run.learner.diagnose(evaluation)
    assert found["truth_r2_x"] == pytest.approx(1.0)
    # 200 goals and starts are uncorrelated but for chance.
    assert abs(found["truth_r2_goal_x"]) < 0.1
    assert found["latent_r2_0"] == found["latent_r2_1"] == pytest.approx(1.0)
    assert abs(found["latent_r2_2"]) < 0.1


def test_without_truth_there_is_no_diagnosis(tmp_path):
    run = Run(tmp_path, "solar").iterate(1, 1)
    [episodes] = run.environment.collected(1)
    blind = Evaluation(episodes, {}, np.empty((len(episodes), 7, 0)))
    assert run.learner.diagnose(blind) == {}


@both
def test_a_trained_method_shows_what_it_sees(tmp_path, name):
    run = Run(tmp_path, name).iterate(1, 1)
    [episodes] = run.environment.collected(1)
    found = run.learner.reconstruct(episodes[:2])
    assert found.shape == episodes.frames[:2].shape
    assert found.dtype == np.uint8
