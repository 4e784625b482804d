"""Each part and extra of the local methods can be turned off alone, and does then what is said."""

import numpy as np
import pytest
import torch
from collected_episodes import collected_in
from method_runs import Run

from solar_cli.control.lqr import lqr_backward
from solar_cli.episodes import Episodes
from solar_cli.methods import local, solar
from solar_cli.models.representation import Representation

every = pytest.mark.parametrize("name", ["solar", "vae", "lqr-flm"])
FEW = ("components=3",)
"""of LQR-FLM's numbers of an image, so that there are more episodes than regressors"""


def small(name: str, *sets: str) -> tuple[str, ...]:
    return (*(FEW if name == "lqr-flm" else ()), "batches={ initial = 14, noisy = 14 }", *sets)


def answers(monkeypatch, page, name):
    """What a function of the page was given, and gave, at each call."""
    calls, function = [], getattr(page, name)

    def called(*given):
        calls.append((given, function(*given)))
        return calls[-1][1]

    monkeypatch.setattr(page, name, called)
    return calls


@every
def test_without_posterior_inference_each_time_step_is_least_squares_alone(
    tmp_path, monkeypatch, name
):
    calls = answers(monkeypatch, local, "infer_dynamics")
    Run(tmp_path, name, *small(name, 'local_fit.method="regression"')).iterate(1, 2)
    (states, older, *_), found = calls[1]
    assert older  # which are not used
    z, actions = states.z.numpy(), states.actions.numpy()
    for t in range(6):
        design = np.column_stack([z[:, t], actions[:, t], np.ones(len(z))])
        solution = np.linalg.lstsq(design, z[:, t + 1], rcond=None)[0]
        fitted = torch.cat([found.model.F[t], found.model.f[t, :, None]], dim=1).numpy()
        np.testing.assert_allclose(design @ fitted.T, design @ solution, atol=1e-6)
    assert not any(key.startswith("prior_") for key in found.metrics)


@every
def test_without_a_kl_bound_the_update_is_the_best_under_its_model(tmp_path, monkeypatch, name):
    calls = answers(monkeypatch, solar, "improve_policy")
    sets = small(name, 'update.kl_step="unbounded"', "update.std_ceiling=1e6")
    Run(tmp_path, name, *sets, "update.std_floor=[1e-9, 1e-9]").iterate(1, 2)
    for (_, dynamics, cost, bound, _), update in calls:
        assert bound is None
        best, definite = lqr_backward(dynamics, cost)
        assert bool(definite)
        torch.testing.assert_close(update.policy.K, best.K)
        torch.testing.assert_close(update.policy.k, best.k)


@every
def test_without_whitening_states_are_what_the_frames_were_encoded_as(tmp_path, name):
    run = Run(tmp_path, name, *small(name, "whitening=false")).iterate(1, 2)
    episodes = collected_in(2, run.environment)
    z = run.learner.representation.embed(episodes)
    assert torch.equal(z, torch.as_tensor(run.learner.encode(episodes)))
    white = Run(tmp_path / "white", name, *small(name)).iterate(1, 1).learner
    z = white.representation.embed(collected_in(1, run.environment))
    assert not torch.equal(z, torch.as_tensor(white.encode(collected_in(1, run.environment))))


@pytest.mark.parametrize("name", ["solar", "vae"])
@pytest.mark.parametrize("attempts", [1, 2])
def test_without_restarts_what_looks_dead_is_kept(tmp_path, monkeypatch, name, attempts):
    monkeypatch.setattr(Representation, "_alive", lambda *_: False)
    run = Run(tmp_path, name, f"training.attempts={attempts}").iterate(1, 1)
    assert run.metrics[0]["discarded_trainings"] == attempts - 1.0
    assert run.metrics[0]["alive"] == 0.0


@every
def test_without_rejection_the_newest_is_built_upon_and_handed_over_however_bad(
    tmp_path, monkeypatch, name
):
    """Each policy costs more than the one before, and each update promises to be worse still."""
    monkeypatch.setattr(local, "promised_fall", lambda *_, **__: -1.0)
    worse = lambda iteration, costs: costs + 100.0 * iteration  # noqa: E731
    for reject, kept in (("1.0", False), ('"never"', True)):
        sets = small(name, f"update.reject={reject}")
        run = Run(tmp_path / str(kept), name, *sets, costs=worse).iterate(1, 1)
        for iteration in (2, 3):
            tried = run.learner.gains
            run.iterate(iteration, iteration)
            assert (run.learner.trust_region.current.iteration == iteration) == kept
            assert (run.learner.trust_region.current.gains is tried) == kept
            assert (run.learner.handed is run.learner.gains) == kept
            assert run.metrics[-1]["rejected"] == float(not kept)
            assert run.metrics[-1]["handed_over_untried"] == float(kept)


@every
@pytest.mark.parametrize("learned_from", [0, 1])
def test_without_rejected_batches_what_was_taken_back_is_another_iterations(
    tmp_path, monkeypatch, name, learned_from
):
    calls = answers(monkeypatch, local, "infer_dynamics")
    worse = lambda iteration, costs: costs + {2: 1e3}.get(iteration, 0.0)  # noqa: E731
    sets = small(name, f"update.rejected_batches={learned_from}")
    run = Run(tmp_path, name, *sets, costs=worse).iterate(1, 2)
    (newest, older, *_), _ = calls[1]
    best, rejected = (collected_in(iteration, run.environment) for iteration in (1, 2))
    together = [best, rejected] if learned_from else [best]
    np.testing.assert_array_equal(newest.costs, Episodes.joined(together).costs)
    assert len(older) == 1 - learned_from
    if older:
        np.testing.assert_array_equal(older[0].costs, rejected.costs)
