"""A structured posterior against the joint Gaussian of its segments, in NumPy; and its filter."""

import math

import numpy as np
import pytest
import torch
from bits import digest, through_a_file
from model_problems import made_up_segments, vector_task
from scipy import special

from solar_cli.errors import UsageError
from solar_cli.inference import mniw, niw
from solar_cli.models import smoothing
from solar_cli.models.frames import FrameModel
from solar_cli.models.latent_model import LatentModel, Minibatch
from solar_cli.models.priors import BayesianLDS, Segments
from solar_cli.models.smoothing import PACE, SmoothedLDS, linear_dynamics
from solar_cli.settings.local import Dynamics, Representation

T, SHOWN, a = 6, 2, 1
TASK = vector_task(horizon=T, actions=a)
every_form = pytest.mark.parametrize(
    ("factors", "hidden"), [("shared", 0), ("shared", 1), ("varying", 0), ("varying", 1)]
)


def made(factors="shared", hidden=0, taught=True, **settings) -> SmoothedLDS:
    chosen = Dynamics(posterior="smoother", factors=factors, hidden=hidden, **settings)
    prior = SmoothedLDS(chosen, SHOWN, TASK, "cpu")
    if taught:
        prior.conclude(whole_episodes(seed=5))
        prior.settle()
    return prior


def whole_episodes(seed=0, count=5) -> Segments:
    return made_up_segments(seed, [0] * count, T + 1, SHOWN, a)


def beliefs(prior, t):
    """(Psi, nu, M, V) of the transition from t and (Psi, nu, mu0, kappa) of z_0, as NumPy."""
    factor = prior.factor
    if factor.yy.ndim == 3:
        factor = mniw.RegressionStatistics(*(part[t] for part in factor))
    return (
        [np.asarray(part) for part in mniw.standard(factor)],
        [np.asarray(part) for part in niw.standard(prior.initial)],
    )


def joint(prior, segments, s, frames):
    """(mean, covariance, log Z, E_q of the evidence's log) of a segment's first frames, dense.

    log Z normalises exp(E log p(z) + evidence), the evidence without constants.
    """
    d = SHOWN + prior.hidden
    size = frames * d
    precision, linear, constant = np.zeros((size, size)), np.zeros(size), 0.0
    start = int(segments.start[s])

    def expected_log_det(Psi, nu):
        total = d * math.log(2) - np.linalg.slogdet(Psi)[1]
        return total + sum(special.digamma((nu - i) / 2) for i in range(d))

    if start == 0:
        Psi, nu, mean, kappa = beliefs(prior, 0)[1]
        inverse = nu * np.linalg.inv(Psi)
        precision[:d, :d] += inverse
        linear[:d] += inverse @ mean
        constant += 0.5 * (expected_log_det(Psi, nu) - mean @ inverse @ mean - d / kappa)
    else:
        precision[:d, :d] += np.eye(d)
    constant -= 0.5 * size * math.log(2 * math.pi)
    for i in range(frames - 1):
        Psi, nu, M, V = beliefs(prior, start + i)[0]
        inverse = nu * np.linalg.inv(Psi)
        inner = M.T @ inverse @ M + d * V
        u = np.append(segments.actions[s, i], 1.0)
        here, there = slice(i * d, (i + 1) * d), slice((i + 1) * d, (i + 2) * d)
        precision[there, there] += inverse
        precision[here, here] += inner[:d, :d]
        precision[there, here] -= inverse @ M[:, :d]
        precision[here, there] -= (inverse @ M[:, :d]).T
        linear[there] += inverse @ M[:, d:] @ u
        linear[here] -= inner[:d, d:] @ u
        constant += 0.5 * (expected_log_det(Psi, nu) - u @ inner[d:, d:] @ u)
    seen, pull = np.zeros(size), np.zeros(size)
    for i in range(frames):
        seen[i * d : i * d + SHOWN] = 1 / segments.variance[s, i].numpy()
        pull[i * d : i * d + SHOWN] = (segments.mean[s, i] / segments.variance[s, i]).numpy()
    covariance = np.linalg.inv(precision + np.diag(seen))
    mean = covariance @ (linear + pull)
    log_normaliser = constant + 0.5 * (
        mean @ (precision + np.diag(seen)) @ mean
        + np.linalg.slogdet(covariance)[1]
        + size * math.log(2 * math.pi)
    )
    added = pull @ mean - 0.5 * seen @ (mean**2 + np.diag(covariance))
    return mean.reshape(frames, d), covariance, log_normaliser, added


# The posterior


@every_form
@pytest.mark.parametrize("starts", [[0, 0, 0], [0, 2, 1]])
def test_the_posterior_and_its_cost_are_those_of_the_joint_gaussian(factors, hidden, starts):
    prior = made(factors, hidden)
    segments = made_up_segments(1, starts, 4, SHOWN, a)
    found = prior.inferred(segments)
    d, total = SHOWN + hidden, 0.0
    for s in range(len(starts)):
        mean, covariance, log_normaliser, added = joint(prior, segments, s, 4)
        np.testing.assert_allclose(found.mean[s], mean[:, :SHOWN], rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(found.smoothed.mean[s], mean, rtol=1e-8, atol=1e-8)
        for i in range(4):
            block = covariance[i * d : (i + 1) * d, i * d : (i + 1) * d]
            np.testing.assert_allclose(found.smoothed.covariance[s, i], block, rtol=1e-8)
            np.testing.assert_allclose(found.variance[s, i], np.diag(block)[:SHOWN], rtol=1e-8)
        assert float(found.kl[s]) == pytest.approx(added - log_normaliser, rel=1e-8)
        total += added - log_normaliser
    kl = prior.kl(prior.statistics(found))
    assert float(kl) == pytest.approx(total / (4 * len(starts)), rel=1e-8)


def test_the_cost_is_the_divergence_of_the_posterior_from_the_prior():
    """E_q[log q - E log p] by samples of q, each density written out."""
    prior = made(hidden=1)
    segments = made_up_segments(2, [0], 3, SHOWN, a)
    mean, covariance, log_normaliser, _ = joint(prior, segments, 0, 3)
    rng = np.random.default_rng(0)
    z = rng.multivariate_normal(mean.ravel(), covariance, size=200_000)
    centred = z - mean.ravel()
    squared = np.einsum("ni,ij,nj->n", centred, np.linalg.inv(covariance), centred)
    size = mean.size
    log_q = -0.5 * (squared + np.linalg.slogdet(2 * math.pi * covariance)[1])
    shown = z.reshape(-1, 3, SHOWN + 1)[..., :SHOWN]
    variance = segments.variance[0].numpy()
    evidence = (segments.mean[0].numpy() / variance * shown - 0.5 * shown**2 / variance).sum((1, 2))
    # q is exp(E log p + evidence) over its normaliser.
    log_p = log_q + log_normaliser - evidence
    gap = log_q - log_p
    expected, error = gap.mean(), gap.std() / math.sqrt(len(z))
    assert size == 9
    assert float(prior.inferred(segments).kl[0]) == pytest.approx(expected, abs=5 * error)


@every_form
def test_statistics_are_expectations_under_the_posterior(factors, hidden):
    """Sums over transitions of E[y y'], E[y x'], E[x x'], each start of a segment as likely."""
    prior, length, d = made(factors, hidden), 3, SHOWN + hidden
    starts = list(range(T + 2 - length))
    segments = made_up_segments(3, starts, length, SHOWN, a)
    found = prior.statistics(prior.inferred(segments))
    reached = [sum(s <= t < s + length - 1 for s in starts) for t in range(T)]
    times = range(T) if factors == "varying" else [None]
    expected = {
        t: [np.zeros((d, d)), np.zeros((d, d + a + 1)), np.zeros((d + a + 1,) * 2), 0.0]
        for t in times
    }
    first = []
    for s, start in enumerate(starts):
        mean, covariance, _, _ = joint(prior, segments, s, length)
        if start == 0:
            moment = covariance[:d, :d] + np.outer(mean[0], mean[0])
            parts = (moment, mean[0][:, None], np.ones((1, 1)), 1.0)
            first = [len(starts) * part for part in parts]
        for i in range(length - 1):
            u = np.append(segments.actions[s, i], 1.0)
            full = np.zeros((2 * d + a + 1,) * 2)
            vector = np.concatenate([mean[i + 1], mean[i], u])
            rows = np.r_[(i + 1) * d : (i + 2) * d, i * d : (i + 1) * d]
            full[: 2 * d, : 2 * d] = covariance[np.ix_(rows, rows)]
            full += np.outer(vector, vector)
            weight = len(starts) / reached[start + i]
            into = expected[start + i if factors == "varying" else None]
            into[0] += weight * full[:d, :d]
            into[1] += weight * full[:d, d:]
            into[2] += weight * full[d:, d:]
            into[3] += weight
    stacked = [np.stack([expected[t][k] for t in times]) for k in range(4)]
    for left, right in zip(found.transitions, stacked, strict=True):
        np.testing.assert_allclose(left.reshape(right.shape), right, rtol=1e-8, atol=1e-8)
    for left, right in zip(found.starts, first, strict=True):
        np.testing.assert_allclose(left, right, rtol=1e-8, atol=1e-8)


def test_without_hidden_latents_and_all_seen_it_is_the_mean_field():
    """Evidence of no variance leaves nothing to infer: both forms learn the same factor."""
    episodes = whole_episodes()._replace(variance=torch.full((5, T + 1, SHOWN), 1e-9).double())
    smoothed, mean_field = made(taught=False), BayesianLDS(Dynamics(), SHOWN, TASK, "cpu")
    smoothed.conclude(episodes)
    mean_field.conclude(episodes)
    for left, right in zip(smoothed.factor, mean_field.factor, strict=True):
        torch.testing.assert_close(left, right, rtol=1e-5, atol=1e-5)
    for left, right in zip(smoothed.initial, mean_field.initial, strict=True):
        torch.testing.assert_close(left, right, rtol=1e-5, atol=1e-5)


@every_form
def test_coordinate_ascent_never_lowers_the_bound(factors, hidden):
    """log Z less the KL of the parameters bounds the likelihood of the evidence."""
    prior, episodes = made(factors, hidden, taught=False), whole_episodes(seed=4)
    bounds = []
    for _ in range(6):
        log_normaliser = prior.inferred(episodes).smoothed.log_normaliser.sum()
        bounds.append(float(log_normaliser) - sum(prior.metrics().values()))
        BayesianLDS.conclude(prior, prior.inferred(episodes))
    assert (np.diff(bounds) > -1e-9).all(), bounds
    assert bounds[-1] > bounds[0] + 1


def test_what_comes_after_the_end_is_not_there():
    prior, episodes = made(hidden=1), whole_episodes()
    lengths = torch.tensor([T, 2, 4, 1, T])
    live = torch.arange(T + 1) <= lengths[:, None]
    found = prior.statistics(prior.inferred(episodes._replace(live=live)))
    assert found.judged == int(live.sum())
    changed = episodes._replace(
        mean=torch.where(live[..., None], episodes.mean, 9.0),
        actions=torch.where(live[:, 1:, None], episodes.actions, 7.0),
        live=live,
    )
    again = prior.statistics(prior.inferred(changed))
    alone = sum(
        float(joint(prior, episodes, s, n + 1)[3] - joint(prior, episodes, s, n + 1)[2])
        for s, n in enumerate(lengths.tolist())
    )
    assert float(found.kl) == pytest.approx(alone, rel=1e-8)
    assert float(again.kl) == pytest.approx(alone, rel=1e-8)
    for left, right in zip(found.transitions, again.transitions, strict=True):
        torch.testing.assert_close(left, right)
    assert float(found.transitions.n) == float(lengths.sum())


# The model


def tiny(hidden=1) -> LatentModel:
    torch.manual_seed(0)
    layers = ({"kind": "linear", "width": 4, "activation": "none"},)
    table = {"latent": SHOWN, "encoder": layers, "decoder": layers, "likelihood": "gaussian"}
    networks = FrameModel(Representation.model_validate(table), TASK.observation).double()
    for name, parameter in networks.named_parameters():
        if "log_variance" in name:
            torch.nn.init.normal_(parameter, std=0.3)
    return LatentModel(networks, made(hidden=hidden), 0.05)


def minibatch(noise=None) -> Minibatch:
    rng = np.random.default_rng(1)
    draws = rng.normal(size=(3, 4, SHOWN)) if noise is None else noise
    return Minibatch(
        torch.as_tensor(rng.normal(size=(3, 4, 3)).astype(np.float32)),
        torch.as_tensor(rng.normal(size=(3, 3, a))),
        torch.tensor([0, 1, 0]),
        torch.as_tensor(draws),
        torch.tensor([0, 3, 5, 11]),
    )


def test_elbo_gradients_are_those_of_finite_differences(monkeypatch):
    """Ordinary reverse mode through the smoother: samples in float64 here, to be differenced."""
    monkeypatch.setattr(torch.Tensor, "float", lambda self: self)
    model, batch = tiny(), minibatch()
    model.loss(batch, 0.7)[0].backward()
    rng = np.random.default_rng(2)
    for name, parameter in model.networks.named_parameters():
        for _ in range(3):
            index = tuple(int(rng.integers(size)) for size in parameter.shape)
            values = []
            with torch.no_grad():
                start = float(parameter[index])
                for k in (-2, -1, 1, 2):
                    parameter[index] = start + k * 1e-4
                    values.append(float(model.loss(batch, 0.7)[0]))
                parameter[index] = start
            expected = (values[0] - 8 * values[1] + 8 * values[2] - values[3]) / 12e-4
            assert float(parameter.grad[index]) == pytest.approx(expected, rel=1e-5, abs=1e-6), name


def test_samples_have_the_moments_of_the_posterior_of_their_frame():
    prior, count = made(hidden=1), 40_000
    segments = made_up_segments(1, [2], 3, SHOWN, a)
    posterior = prior.inferred(segments)
    noise = np.random.default_rng(0).normal(size=(count, 3, SHOWN))
    repeated = segments._replace(
        **{
            f: getattr(segments, f).expand(count, *getattr(segments, f).shape[1:])
            for f in ("mean", "variance", "actions", "start")
        }
    )
    sample, _ = prior.sampled(repeated, torch.as_tensor(noise))
    assert sample.dtype == torch.float32
    for i in range(3):
        drawn = sample[:, i].double().numpy()
        covariance = posterior.smoothed.covariance[0, i, :SHOWN, :SHOWN].numpy()
        error = np.sqrt(np.diag(covariance) / count)
        assert (np.abs(drawn.mean(0) - posterior.mean[0, i].numpy()) < 5 * error).all()
        spread = np.sqrt(
            (np.outer(np.diag(covariance), np.diag(covariance)) + covariance**2) / count
        )
        assert (np.abs(np.cov(drawn.T) - covariance) < 5 * spread).all()


# What control sees


@every_form
def test_what_is_read_is_the_posterior_of_the_frames_so_far(factors, hidden):
    prior, episodes = made(factors, hidden), whole_episodes()
    seen = prior.read(episodes)
    assert seen.shape == (5, T + 1, SHOWN + hidden)
    for s in range(5):
        for t in range(T + 1):
            mean = joint(prior, episodes, s, t + 1)[0][-1]
            np.testing.assert_allclose(seen[s, t], mean, rtol=1e-7, atol=1e-7)


def test_following_is_reading_step_by_step_whatever_comes_later():
    prior, episodes = made(hidden=1), whole_episodes()
    seen, belief = prior.read(episodes), None
    for t in range(T + 1):
        actions = episodes.actions[:, t - 1] if t else None
        now, belief = prior.follow(episodes.mean[:, t], episodes.variance[:, t], belief, actions, t)
        torch.testing.assert_close(now, seen[:, t], rtol=0, atol=0)


def test_what_is_read_is_settled_until_the_next_training():
    prior, episodes = made(hidden=1), whole_episodes()
    seen = prior.read(episodes)
    prior.conclude(whole_episodes(seed=9))
    assert torch.equal(prior.read(episodes), seen)
    prior.settle()
    assert not torch.allclose(prior.read(episodes), seen)


def test_a_velocity_that_no_frame_shows_is_read():
    """Positions that move at a speed of their own: the filter finds it, and predicts by it."""
    rng = np.random.default_rng(0)
    task = vector_task(horizon=20, actions=a)
    prior = SmoothedLDS(Dynamics(posterior="smoother", hidden=2), 2, task, "cpu")
    speed = rng.normal(0, 0.1, (200, 1, 2)) * np.ones((1, 21, 1))
    place = rng.normal(size=(200, 1, 2)) + np.cumsum(speed, axis=1)
    seen = place + rng.normal(0, 0.01, place.shape)
    episodes = Segments(
        torch.as_tensor(seen),
        torch.full(seen.shape, 1e-4).double(),
        torch.zeros(200, 20, a).double(),
        torch.zeros(200, dtype=torch.long),
    )
    for _ in range(6):
        prior.conclude(episodes)
    prior.settle()
    latents = prior.read(episodes)[:, 10, :].numpy()
    design = np.column_stack([latents, np.ones(200)])
    for i in range(2):
        target = speed[:, 0, i]
        residual = target - design @ np.linalg.lstsq(design, target, rcond=None)[0]
        # Two places of noise 0.01 give a speed to 0.014, a line through all 11 to 0.001.
        assert residual.std() < 0.014 / 4


def test_older_episodes_tell_line_7_of_what_control_sees():
    prior, episodes = made(hidden=1), whole_episodes(seed=8)
    seen = prior.read(episodes)
    inputs = torch.cat([episodes.actions, torch.ones(5, T, 1).double()], dim=-1)
    x = torch.cat([seen[:, :-1], inputs], dim=-1).flatten(0, 1)
    pairs = mniw.regression_statistics(x, seen[:, 1:].flatten(0, 1))
    for left, right in zip(prior.given(episodes), prior.prior.plus(pairs), strict=True):
        torch.testing.assert_close(left, right)


# Settings and state


def test_a_hidden_latent_is_expected_to_drive_a_shown_one():
    prior = made(hidden=1, taught=False)
    M = mniw.standard(prior.factor).M
    expected = torch.eye(3, 5).double()
    expected[0, 2] = PACE
    torch.testing.assert_close(M, expected)


def test_the_settings_name_the_posterior():
    kinds = [
        linear_dynamics(Dynamics(posterior=p), SHOWN, TASK, "cpu")
        for p in ("mean-field", "smoother")
    ]
    assert [type(kind) for kind in kinds] == [BayesianLDS, SmoothedLDS]


def test_single_frames_are_all_it_sees():
    task = vector_task(horizon=T, window=2)
    with pytest.raises(UsageError, match=r"task\.observation\.window = 1, not 2"):
        SmoothedLDS(Dynamics(posterior="smoother"), SHOWN, task, "cpu")


def test_hidden_latents_need_a_smoother():
    with pytest.raises(ValueError, match="hidden"):
        Dynamics(hidden=1)


def test_a_restored_prior_infers_and_reads_the_same_bits():
    prior, again, episodes = made(hidden=1), made(hidden=1, taught=False), whole_episodes()
    prior.conclude(whole_episodes(seed=9))  # the filter's factors and the newest ones differ
    again.load_state_dict(through_a_file(prior.state_dict()))
    assert digest(again.state_dict()) == digest(prior.state_dict())
    assert torch.equal(again.read(episodes), prior.read(episodes))
    assert torch.equal(again.inferred(episodes).kl, prior.inferred(episodes).kl)


def test_a_concluding_step_is_one_of_natural_gradient_where_settings_say_so(monkeypatch):
    prior = made(taught=False, closed_form=False, rate=0.3)
    episodes = whole_episodes()
    found = prior.statistics(prior.inferred(episodes)).transitions
    prior.conclude(episodes)
    target = prior.prior.plus(found)
    for now, before, to in zip(prior.factor, prior.prior, target, strict=True):
        torch.testing.assert_close(now, 0.7 * before + 0.3 * to)
    assert smoothing.ROUNDS > 1
