"""Chains of Gaussians against the joint Gaussian of a whole trajectory, written out densely."""

import math

import pytest
import torch

from solar_cli.inference import lds, mniw, niw
from solar_cli.inference.mniw import ExpectedStatistics

S, N, D, M = 3, 5, 2, 3  # chains, transitions, latents, inputs with the constant 1


def normal(*shape, seed):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def covariance(*batch, seed, size=D):
    root = normal(*batch, size, size, seed=seed)
    return root @ root.mT + 0.3 * torch.eye(size)


def inputs(seed=0):
    free = normal(S, N, M - 1, seed=seed)
    return torch.cat([free, torch.ones_like(free[..., :1])], dim=-1)


def evidence(seed=1):
    """Means and variances; the first latent is hardly seen."""
    scale = torch.tensor([1e3, 1.0])
    return normal(S, N + 1, D, seed=seed), scale * normal(S, N + 1, D, seed=seed + 1).exp()


def beliefs(varying=False):
    """(initial, dynamics): expectations of wide beliefs, so that all of their terms count."""
    batch = (N,) if varying else ()
    degrees = torch.tensor(D + 3.0)
    q = mniw.MNIW(
        covariance(*batch, seed=3),
        degrees.double().expand(batch),
        0.5 * normal(*batch, D, D + M, seed=4),
        0.1 * covariance(*batch, seed=5, size=D + M),
    )
    start = niw.NIW(
        covariance(seed=6), degrees.double(), normal(D, seed=7), torch.tensor(0.7).double()
    )
    dynamics = mniw.expected_statistics(mniw.natural(q))
    return mniw.expected_statistics(niw.natural(start)), dynamics


def certain(varying=False):
    """(initial, dynamics) that are known, and what they are: mean, covariance, F, S."""
    batch = (N,) if varying else ()
    F, noise = normal(*batch, D, D + M, seed=8), covariance(*batch, seed=9)
    mean, spread = normal(D, seed=10), covariance(seed=11)
    initial = lds.known_dynamics(mean[:, None], spread)
    return (initial, lds.known_dynamics(F, noise)), (mean, spread, F, noise)


def expected_log_density(initial, dynamics, u, z):
    """log p(z_0) + sum log p(z_{t+1} | z_t, u_t) of one chain, term by term, in expectation."""

    def term(expected, x, y):
        quadratic = y @ expected.precision @ y - 2 * y @ expected.precision_F @ x
        quadratic = quadratic + x @ expected.F_precision_F @ x
        return (expected.log_det_precision - len(y) * math.log(2 * math.pi) - quadratic) / 2

    total = term(initial, torch.ones(1, dtype=torch.float64), z[0])
    for t in range(len(u)):
        at = dynamics
        if dynamics.precision.ndim == 3:
            at = ExpectedStatistics(*(part[t] for part in dynamics))
        total = total + term(at, torch.cat([z[t], u[t]]), z[t + 1])
    return total


def dense(initial, dynamics, u, mean, variance):
    """Mean (S, n1 d), covariance and log normaliser: derivatives of the log density at zero."""
    found = []
    for s in range(S):

        def log_density(flat, s=s):
            z = flat.view(N + 1, D)
            seen = ((mean[s] / variance[s]) * z - 0.5 * z.square() / variance[s]).sum()
            return expected_log_density(initial, dynamics, u[s], z) + seen

        zero = torch.zeros((N + 1) * D, dtype=torch.float64)
        precision = -torch.autograd.functional.hessian(log_density, zero)
        linear = torch.autograd.functional.jacobian(log_density, zero)
        spread = torch.linalg.inv(precision)
        log_normaliser = log_density(zero) + 0.5 * (
            linear @ spread @ linear - torch.logdet(precision) + len(zero) * math.log(2 * math.pi)
        )
        found.append((spread @ linear, spread, log_normaliser))
    return [torch.stack(part) for part in zip(*found, strict=True)]


def smoothed(initial, dynamics, u, mean, variance):
    chain = lds.prior_chain(initial, dynamics, u)
    return lds.smooth(chain.given(lds.Evidence.gaussian(mean, variance)))


def filtered(initial, dynamics, u, mean, variance):
    """Beliefs about each state given the evidence so far."""
    belief, found = lds.initial_belief(initial), []
    for t in range(N + 1):
        if t:
            at = dynamics
            if dynamics.precision.ndim == 3:
                at = ExpectedStatistics(*(part[t - 1] for part in dynamics))
            belief = lds.predicted(belief, at, u[:, t - 1])
        belief = belief.given(lds.Evidence.gaussian(mean[:, t], variance[:, t]))
        found.append(belief)
    return found


@pytest.mark.parametrize("varying", [False, True])
@pytest.mark.parametrize("known", [False, True])
def test_marginals_and_normaliser_are_those_of_the_joint_gaussian(varying, known):
    initial, dynamics = certain(varying)[0] if known else beliefs(varying)
    u, (mean, variance) = inputs(), evidence()
    found = smoothed(initial, dynamics, u, mean, variance)
    joint_mean, joint, log_normaliser = dense(initial, dynamics, u, mean, variance)
    blocks = joint.view(S, N + 1, D, N + 1, D).transpose(2, 3)
    times = torch.arange(N + 1)
    torch.testing.assert_close(found.mean, joint_mean.view(S, N + 1, D))
    torch.testing.assert_close(found.covariance, blocks[:, times, times])
    torch.testing.assert_close(found.cross, blocks[:, times[:-1], times[1:]])
    torch.testing.assert_close(found.log_normaliser, log_normaliser)


@pytest.mark.parametrize("varying", [False, True])
def test_known_dynamics_are_a_density_that_moves_as_they_say(varying):
    """Without evidence: the normaliser is 1, moments follow the recursion of a Gaussian."""
    (initial, dynamics), (mean, spread, F, noise) = certain(varying)
    u = inputs()
    found = lds.smooth(lds.prior_chain(initial, dynamics, u))
    torch.testing.assert_close(found.log_normaliser, torch.zeros(S).double(), atol=1e-9, rtol=0)
    mean = mean.expand(S, D)
    for t in range(N + 1):
        torch.testing.assert_close(found.mean[:, t], mean)
        torch.testing.assert_close(found.covariance[:, t], spread.expand(S, D, D))
        if t == N:
            break
        map_, added = (F[t], noise[t]) if varying else (F, noise)
        torch.testing.assert_close(found.cross[:, t], (spread @ map_[:, :D].T).expand(S, D, D))
        mean = torch.cat([mean, u[:, t]], dim=-1) @ map_.T
        spread = map_[:, :D] @ spread @ map_[:, :D].T + added


@pytest.mark.parametrize("varying", [False, True])
def test_the_filter_is_the_smoother_of_the_frames_so_far(varying):
    initial, dynamics = beliefs(varying)
    u, (mean, variance) = inputs(), evidence()
    for t, belief in enumerate(filtered(initial, dynamics, u, mean, variance)):
        at = dynamics
        if varying:
            at = ExpectedStatistics(*(part[:t] for part in dynamics))
        so_far = smoothed(initial, at, u[:, :t], mean[:, : t + 1], variance[:, : t + 1])
        torch.testing.assert_close(belief.mean, so_far.mean[:, -1])
        torch.testing.assert_close(torch.linalg.inv(belief.precision), so_far.covariance[:, -1])


def test_states_that_are_not_live_change_nothing():
    """Each chain is that of its live states alone, and standard normals, without evidence."""
    initial, dynamics = beliefs()
    u, (mean, variance) = inputs(), evidence()
    lengths = torch.tensor([N, 2, 0])
    live = torch.arange(N + 1) <= lengths[:, None]
    seen = lds.Evidence(*(p * live[..., None] for p in lds.Evidence.gaussian(mean, variance)))
    found = lds.smooth(lds.prior_chain(initial, dynamics, u, live).given(seen))
    for s, n in enumerate(lengths.tolist()):
        rows = slice(s, s + 1)
        alone = smoothed(
            initial, dynamics, u[rows, :n], mean[rows, : n + 1], variance[rows, : n + 1]
        )
        torch.testing.assert_close(found.mean[rows, : n + 1], alone.mean)
        torch.testing.assert_close(found.covariance[rows, : n + 1], alone.covariance)
        torch.testing.assert_close(found.cross[rows, :n], alone.cross)
        torch.testing.assert_close(found.log_normaliser[rows], alone.log_normaliser)
        torch.testing.assert_close(found.mean[s, n + 1 :], torch.zeros(N - n, D).double())


def test_each_chain_may_have_a_start_of_its_own():
    (initial, dynamics), _ = certain()
    other, _ = beliefs()
    u, (mean, variance) = inputs(), evidence()
    mixed = ExpectedStatistics(
        *(torch.stack([a, b, a]) for a, b in zip(initial, other, strict=True))
    )
    found = smoothed(mixed, dynamics, u, mean, variance)
    for start, rows in ((initial, [0, 2]), (other, [1])):
        alone = smoothed(start, dynamics, u, mean, variance)
        for left, right in zip(found, alone, strict=True):
            torch.testing.assert_close(left[rows], right[rows])


def test_everything_is_differentiable_in_the_evidence():
    initial, dynamics = beliefs()
    u, (mean, variance) = inputs(), evidence()
    rows, steps = slice(0, 1), slice(0, 3)

    def everything(mean, log_variance):
        return tuple(smoothed(initial, dynamics, u[rows, :2], mean, log_variance.exp()))

    log_variance = variance[rows, steps].log()
    leaves = (mean[rows, steps].clone().requires_grad_(), log_variance.clone().requires_grad_())
    assert torch.autograd.gradcheck(everything, leaves)


def test_the_normalisers_gradient_is_the_mean():
    """d log Z / d (linear term) is E z: the identity that the release differentiates for."""
    initial, dynamics = beliefs()
    u, (mean, variance) = inputs(), evidence()
    linear = (mean / variance).requires_grad_()
    chain = lds.prior_chain(initial, dynamics, u).given(lds.Evidence(1 / variance, linear))
    found = lds.smooth(chain)
    [gradient] = torch.autograd.grad(found.log_normaliser.sum(), linear)
    torch.testing.assert_close(gradient, found.mean.detach())


def test_a_long_chain_of_small_noise_keeps_its_digits():
    """Positions that a velocity drives, noise of 1e-4, a hundred steps: against Kalman's form."""
    F = torch.tensor([[1.0, 0.1, 0.0], [0.0, 1.0, 0.05]], dtype=torch.float64)
    noise = 1e-8 * torch.eye(2, dtype=torch.float64)
    n, seen = 100, torch.tensor([1e-4, 1e8], dtype=torch.float64)
    initial = lds.known_dynamics(torch.zeros(2, 1).double(), torch.eye(2).double())
    u = torch.ones(1, n, 1, dtype=torch.float64)
    positions = normal(1, n + 1, 2, seed=12)
    belief = lds.initial_belief(initial)
    mean, spread = torch.zeros(2, 1).double(), torch.eye(2).double()
    for t in range(n + 1):
        if t:
            belief = lds.predicted(belief, lds.known_dynamics(F, noise), u[:, t - 1])
            mean = F[:, :2] @ mean + F[:, 2:]
            spread = F[:, :2] @ spread @ F[:, :2].T + noise
        belief = belief.given(lds.Evidence.gaussian(positions[:, t], seen.expand(1, 2)))
        gain = spread @ torch.linalg.inv(spread + torch.diag(seen))
        mean = mean + gain @ (positions[0, t][:, None] - mean)
        keep = torch.eye(2).double() - gain
        spread = keep @ spread @ keep.T + gain @ torch.diag(seen) @ gain.T
    torch.testing.assert_close(belief.mean[0], mean[:, 0], rtol=1e-6, atol=1e-6)
