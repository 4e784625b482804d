"""LQR-FLM is Algorithm 1's page with nothing to train: states, or components of images."""

import math

import numpy as np
import pytest
import torch
from collected_episodes import collected_in
from method_runs import Run

from solar_cli.envs import build_task
from solar_cli.episodes import evaluate
from solar_cli.errors import UsageError
from solar_cli.settings import MethodEntry, cells, load_card, method
from solar_cli.streams import Streams


def configured(task: str, *sets: str):
    return cells(load_card(task), "lqr-flm", [0], "default", sets, "x" if sets else None)[0]


def test_it_acts_on_components_of_images(tmp_path):
    run = Run(tmp_path, "lqr-flm", "components=3").iterate(1, 2)
    episodes = collected_in(2, run.environment)
    z = run.learner.representation.embed(episodes)
    assert z.shape == (len(episodes), 7, 3)
    # The policy that collected them was linear in them.
    newest = run.learner.trust_region.current
    assert newest.iteration == 2
    means = torch.einsum("tij,ntj->nti", newest.gains.K, z[:, :-1]) + newest.gains.k
    torch.testing.assert_close(means, torch.from_numpy(episodes.action_means), rtol=1e-4, atol=1e-5)
    assert bool(newest.gains.K.any())
    found = run.learner.reconstruct(episodes)
    assert (found.shape, found.dtype) == (episodes.frames.shape, np.uint8)
    assert run.learner.encode(episodes).shape == (len(episodes), 7, 3)


def test_local_dynamics_have_a_mixture_prior_and_no_other(tmp_path, monkeypatch):
    run = Run(tmp_path, "lqr-flm").iterate(1, 1)
    assert run.learner.settings.local_fit.method == "gmm"
    assert run.learner.representation.dynamics_prior([], as_it_stands=True).factor is None


def test_its_metrics_are_finite_numbers_and_tell_of_what_is_not_trained_nothing(tmp_path):
    run = Run(tmp_path, "lqr-flm").iterate(1, 2)
    watched = {"least_explained_variance", "one_step_r2", "cost_r2", "policy_kl", "policy_std"}
    watched |= {"predicted_improvement", "actual_improvement", "rejected"}
    assert watched <= set(run.metrics[1])
    for metrics in run.metrics:
        assert all(isinstance(v, float) and math.isfinite(v) for v in metrics.values())
        assert not {"alive", "held_out_elbo", "kl_dynamics"} & set(metrics)


def test_diagnosis_is_of_its_components(tmp_path):
    run = Run(tmp_path, "lqr-flm").iterate(1, 1)
    task = run.configuration.task
    evaluation = evaluate(build_task(task), task, run.learner.policy, 20, Streams(5))
    found = run.learner.diagnose(evaluation)
    assert len([name for name in found if name.startswith("latent_r2")]) == 20


@pytest.mark.parametrize(
    ("task", "size"), [("car-states", 9), ("pusher", 23), ("nav", 20), ("car", 20)]
)
def test_observed_states_are_taken_whole_and_images_by_components(task, size):
    configuration = configured(task).configuration
    assert configuration.method.latents(configuration.task.observation) == size


def test_more_components_than_fifty_are_refused():
    assert configured("nav", "methods.lqr-flm.components=50")
    with pytest.raises(UsageError, match="components"):
        configured("nav", "methods.lqr-flm.components=51")


def test_its_entry_says_that_images_are_seen_by_components():
    entry: MethodEntry = method("lqr-flm")
    assert "principal components" in entry.summary
    assert "principal components" in entry.deviations
    assert "Levine" in entry.source
