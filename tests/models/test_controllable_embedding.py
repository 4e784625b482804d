"""RCE's bound against closed forms, Monte Carlo and loops; its transitions against torch.linalg."""

import math

import numpy as np
import pytest
import torch
from model_problems import made_up_segments, vector_task

from solar_cli.models.controllable_embedding import ControllableEmbedding
from solar_cli.models.priors import Segments
from solar_cli.models.transition import Local, RankOne
from solar_cli.settings.local import Transition
from solar_cli.streams import Streams

T, d, a = 6, 2, 1
STD = 0.3  # of exploration, in `vector_task`
windows = pytest.mark.parametrize("window", [1, 3])


def embedding(window=1, seed=0, wild=True) -> ControllableEmbedding:
    """With weights of a size that no training would give; or as they are at first."""
    torch.manual_seed(seed)
    settings = Transition(hidden=(7,), recognition=(5,), steps=3, batch=4)
    task = vector_task(T, window=window, actions=a)
    made = ControllableEmbedding(settings, d, task, Streams(0), "cpu")
    if wild:
        for parameter in made.parameters():
            torch.nn.init.normal_(parameter, std=0.4)
        network = made.transition
        network.mean.normal_(), network.std.uniform_(0.5, 1.5)
        network.difference_std.uniform_(0.2, 0.6)
    return made


def drawn(segments: Segments, seed=0) -> Segments:
    noise = np.random.default_rng(seed).normal(size=segments.mean.shape)
    return segments._replace(noise=torch.as_tensor(noise))


def silence(recognition):
    """q(zbar | x, z^) = p(zbar | x)."""
    for parameter in recognition[-1].parameters():
        torch.nn.init.zeros_(parameter)


def log_of_mean(logs):
    """The logarithm of an average of exponentials, and its standard error."""
    average = torch.logsumexp(logs, 0) - math.log(len(logs))
    return average, (logs - average).exp().std() / math.sqrt(len(logs))


def log_normal(x, mean, covariance):
    gaussian = torch.distributions.MultivariateNormal(mean, covariance)
    return gaussian.log_prob(x)


# A = I + v r^T


def test_rank_one_maps_are_those_of_torch_linalg():
    torch.manual_seed(0)
    v, r, z = torch.randn(3, 50, 5, dtype=torch.float64)
    A, dense = RankOne(v, r), torch.eye(5).double() + v[:, :, None] * r[:, None, :]
    torch.testing.assert_close(A.times(z), (dense @ z[..., None])[..., 0])
    torch.testing.assert_close(A.solve(z), torch.linalg.solve(dense, z))
    torch.testing.assert_close(A.log_determinant(), torch.linalg.slogdet(dense)[1])
    assert (torch.linalg.det(dense) < 0).any()


@windows
def test_the_reverse_transition_undoes_the_transition(window):
    network = embedding(window).transition
    z, e, u = (torch.randn(20, n).double() for n in (d, (window - 1) * d, a))
    place = Local(z, e, u)
    coefficients = network.at(place)
    torch.testing.assert_close(coefficients.backward(coefficients.forward(place), place), z)


@windows
def test_derivatives_are_those_of_finite_differences(window):
    network = embedding(window).transition
    points, actions = torch.randn(4, window * d).double(), torch.randn(4, a).double()
    of_windows, of_actions = network.slopes(points, actions)
    step = 1e-6
    for found, inputs, which in ((of_windows, points, 0), (of_actions, actions, 1)):
        for j in range(inputs.shape[1]):
            moved = [[points, actions], [points, actions]]
            for k, sign in enumerate((1, -1)):
                moved[k][which] = inputs.clone()
                moved[k][which][:, j] += sign * step
            plus, minus = (network(*pair).detach() for pair in moved)
            torch.testing.assert_close(
                found[..., j], (plus - minus) / (2 * step), rtol=1e-5, atol=1e-7
            )


# The bound


def linear_gaussian(seed=0):
    """log p(x' | x, u) in closed form: the same A, B, o at every place, and x' = D z^ + noise."""
    prior = embedding(seed=seed)
    network = prior.transition
    torch.nn.init.zeros_(network.layers[-1].weight)
    silence(prior.recognition)
    rng = np.random.default_rng(seed)
    mu, std, u, x = (torch.as_tensor(rng.normal(size=n)) for n in (d, d, a, 3))
    std = std.abs() + 0.2
    D, R = torch.as_tensor(rng.normal(size=(3, d))), 0.3 * torch.eye(3).double()
    v, r, _, B, o = network.layers[-1].bias.split([d, d, 0, d * a, d])
    unit = torch.diag(network.std)
    A = unit @ (torch.eye(d) + torch.outer(v, r)) @ torch.linalg.inv(unit)
    moved = network.std * (B.view(d, a) @ (u / STD) + o) + network.mean - A @ network.mean
    mean, covariance = (A @ mu + moved).detach(), (A @ torch.diag(std**2) @ A.T).detach()
    return prior, Local(mu, torch.zeros(0).double(), u), std, x, D, R, mean, covariance


def bound(prior, now, std, x, D, R, q, samples):
    """E log p(x' | z^) - log q(z^ | x') and the prior's terms, for each of some samples of q."""
    successor = q.sample((samples,))
    many = Local(*(part.expand(samples, -1) for part in now))
    noise = torch.randn(samples, d, dtype=torch.float64)
    terms = prior.terms(many, std.expand(samples, -1), successor, noise).detach()
    return log_normal(x, successor @ D.T, R) - q.log_prob(successor) - terms


@pytest.mark.parametrize("seed", range(3))
def test_the_bound_is_tight_where_q_is_the_posterior(seed):
    """Then every sample of z^ gives log p(x' | x, u) itself."""
    prior, now, std, x, D, R, mean, covariance = linear_gaussian(seed)
    evidence = log_normal(x, D @ mean, D @ covariance @ D.T + R)
    gain = covariance @ D.T @ torch.linalg.inv(D @ covariance @ D.T + R)
    spread = covariance - gain @ D @ covariance
    posterior = torch.distributions.MultivariateNormal(mean + gain @ (x - D @ mean), spread)
    found = bound(prior, now, std, x, D, R, posterior, 50)
    torch.testing.assert_close(found, evidence.expand(50), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_the_bound_falls_short_by_the_divergence_of_q_from_the_posterior(seed):
    torch.manual_seed(seed)
    prior, now, std, x, D, R, mean, covariance = linear_gaussian(seed)
    evidence = log_normal(x, D @ mean, D @ covariance @ D.T + R)
    gain = covariance @ D.T @ torch.linalg.inv(D @ covariance @ D.T + R)
    spread = covariance - gain @ D @ covariance
    posterior = torch.distributions.MultivariateNormal(mean + gain @ (x - D @ mean), spread)
    q = torch.distributions.MultivariateNormal(mean + 0.2, 0.5 * torch.diag(spread.diagonal()))
    divergence = torch.distributions.kl_divergence(q, posterior)
    found = bound(prior, now, std, x, D, R, q, 40_000)
    error = found.std() / math.sqrt(len(found))
    assert divergence > 20 * error
    assert abs(found.mean() - (evidence - divergence)) < 4 * error


@pytest.mark.parametrize("looks", [False, True], ids=["q is p", "q looks at what came"])
def test_the_bound_holds_where_the_place_of_the_linearisation_matters(looks):
    """log p(x' | x, u) is then an average over zbar, and over samples of q that of the weights."""
    torch.manual_seed(0)
    _, now, std, x, D, R, *_ = linear_gaussian()
    prior, many = embedding(seed=3), 200_000
    if not looks:
        silence(prior.recognition)
    network = prior.transition
    place = network.in_units(Local(*(part.expand(many, -1) for part in now)))
    zbar = place.z + std / network.std * torch.randn(many, d, dtype=torch.float64)
    local = network.at(place._replace(z=zbar))
    A = torch.eye(d) + local.A.v[:, :, None] * local.A.r[:, None, :]
    A = (network.std[:, None] * A / network.std).detach()
    centre = network.plain(local.forward(place)).detach()
    covariances = A @ torch.diag(std**2) @ A.mT
    evidence, error = log_of_mean(log_normal(x, centre @ D.T, D @ covariances @ D.T + R))
    spread = covariances.mean(0) + centre.T.cov()
    gain = spread @ D.T @ torch.linalg.inv(D @ spread @ D.T + R)
    likely = centre.mean(0) + gain @ (x - D @ centre.mean(0))
    q = torch.distributions.MultivariateNormal(likely, 2 * (spread - gain @ D @ spread))
    found = bound(prior, now, std, x, D, R, q, many)
    assert error < 0.01
    assert found.mean() < evidence - 0.1
    if not looks:
        average, more = log_of_mean(found)
        assert more < 0.03
        assert abs(average - evidence) < 4 * (error + more)


# The prior


def by_loops(prior, segments, window):
    """The prior's terms, transition by transition, with dense matrices."""
    network, total = prior.transition, []
    mean, variance, actions, _ = segments[:4]
    for s in range(len(mean)):
        for t in range(window - 1, mean.shape[1] - 1):
            mu, std = mean[s, t], variance[s, t].sqrt()
            successor = mean[s, t + 1] + variance[s, t + 1].sqrt() * segments.noise[s, t + 1]
            e = [mean[s, t - k] - mean[s, t - k - 1] for k in range(window - 1)]
            e = torch.cat([*e, torch.zeros(0)]).double() / network.difference_std
            u = actions[s, t] / STD
            z, after = ((y - network.mean) / network.std for y in (mu, successor))
            seen = torch.cat([z, (std / network.std).log(), e, after])
            shift, log_ratio = prior.recognition(seen).split(d)
            q = torch.distributions.Normal(mu + std * shift, std * log_ratio.exp())
            encoder = torch.distributions.Normal(mu, std)
            zbar = q.loc + q.scale * segments.noise[s, t]
            inputs = torch.cat([(zbar - network.mean) / network.std, e])
            sizes = [d, d, (window - 1) * d * d, d * a, d]
            v, r, C, B, o = network.layers(inputs).split(sizes)
            A = torch.eye(d) + torch.outer(v, r)
            known = C.view(d, -1) @ e + B.view(d, a) @ u + o
            before = torch.linalg.inv(A) @ (after - known) * network.std + network.mean
            entropy = torch.distributions.Normal(mean[s, t + 1], variance[s, t + 1].sqrt())
            total.append(
                torch.distributions.kl_divergence(q, encoder).sum()
                - encoder.log_prob(before).sum()
                + torch.linalg.slogdet(A)[1]
                - entropy.entropy().sum()
            )
    return torch.stack(total).view(len(mean), -1)


@windows
def test_the_prior_is_a_mean_over_transitions_of_the_bounds_terms(window):
    prior = embedding(window)
    segments = drawn(made_up_segments(1, [0, 2, 1], window + 3, d, a))
    expected = by_loops(prior, segments, window)
    torch.testing.assert_close(prior.kl(prior.statistics(segments)), expected.mean())
    live = torch.ones(3, window + 3, dtype=torch.bool)
    live[1, window + 1 :] = False  # the last two transitions of one segment
    lived = torch.cat([expected.flatten()[:4], expected.flatten()[6:]])
    torch.testing.assert_close(prior.kl(segments._replace(live=live)), lived.mean())


@windows
def test_gradients_are_those_of_finite_differences(window):
    prior = embedding(window)
    judged = drawn(made_up_segments(2, [0, 1], window + 2, d, a))

    def total(mean, log_variance, *parameters):
        return prior.kl(judged._replace(mean=mean, variance=log_variance.exp()))

    inputs = judged.mean.clone().requires_grad_(), judged.variance.log().requires_grad_()
    assert torch.autograd.gradcheck(total, (*inputs, *prior.parameters()))


def test_at_first_the_place_is_drawn_from_the_encoder():
    prior = embedding(wild=False)
    seen = torch.randn(9, 3 * d).double()
    assert (prior.recognition(seen) == 0).all()


@windows
def test_units_follow_the_latents(window):
    prior, network = embedding(window, wild=False), embedding(window, wild=False).transition
    segments = made_up_segments(3, [0] * 4, T + 1, d, a)
    prior.learn(prior.statistics(segments), 1.0)
    newest = segments.mean[:, window - 1 : -1].flatten(0, 1)
    torch.testing.assert_close(prior.transition.mean, newest.mean(0))
    expected = (newest.var(0) + segments.variance[:, window - 1 : -1].mean((0, 1))).sqrt()
    torch.testing.assert_close(prior.transition.std, expected)
    for _ in range(2000):
        prior.learn(prior.statistics(segments._replace(mean=3 * segments.mean)), 1.0)
    torch.testing.assert_close(prior.transition.mean, 3 * newest.mean(0))
    assert network.mean.tolist() == [0.0, 0.0]


@windows
def test_fitting_further_takes_units_only_where_there_are_none(window):
    segments = made_up_segments(3, [0] * 4, T + 1, d, a)
    taught, fresh = embedding(window, wild=False), embedding(window, wild=False)
    taught.learn(segments, 1.0)
    units = [part.clone() for part in taught.transition.buffers()]
    for prior in (taught, fresh):
        prior.conclude(segments)
        assert all(map(torch.equal, prior.transition.buffers(), units))
    taught.conclude(segments._replace(mean=2 * segments.mean))
    assert all(map(torch.equal, taught.transition.buffers(), units))


@windows
def test_a_network_that_is_right_has_an_r2_of_one(window):
    prior, segments = embedding(window), made_up_segments(4, [0] * 5, T + 1, d, a)
    mean = segments.mean.clone()
    with torch.no_grad():
        for t in range(window - 1, T):
            recent = torch.cat([mean[:, t - k] for k in range(window)], dim=-1)
            mean[:, t + 1] = prior.transition(recent, segments.actions[:, t])
    right = segments._replace(mean=mean)
    assert prior.judged(right)["transition_r2"] == pytest.approx(1.0)
    still = prior.transition.layers[-1]
    with torch.no_grad():
        still.weight.zero_()
        still.bias.zero_()
    assert prior.judged(right)["transition_r2"] < 0.1


@windows
def test_a_prior_survives_its_state(window):
    prior, fresh = embedding(window), embedding(window, seed=1)
    judged = drawn(made_up_segments(3, [0, 1], window + 2, d, a))
    prior.learn(judged, 1.0)
    fresh.load_state_dict(prior.state_dict())
    assert torch.equal(fresh.kl(judged), prior.kl(judged))
    for each in (prior, fresh):  # what is drawn next is the same, too
        each.conclude(judged)
    assert torch.equal(fresh.kl(judged), prior.kl(judged))


def test_latents_that_follow_the_dynamics_cost_less_than_others_once_it_has_learned():
    prior = embedding(wild=False)
    rng = np.random.default_rng(5)
    z = np.empty((40, T + 1, d))
    actions = rng.normal(size=(40, T, a))
    z[:, 0] = rng.normal(size=(40, d))
    for t in range(T):
        z[:, t + 1] = z[:, t] @ [[1.0, 0.2], [0.0, 1.0]] + actions[:, t] * 0.5
    segments = drawn(
        Segments(
            torch.as_tensor(z),
            torch.full((40, T + 1, d), 1e-2).double(),
            torch.as_tensor(actions),
            torch.zeros(40, dtype=torch.long),
        )
    )
    adam = torch.optim.Adam(prior.parameters(), lr=3e-3)
    for _ in range(300):
        prior.learn(segments, 1.0)
        adam.zero_grad()
        prior.kl(segments).backward()
        adam.step()
    shuffled = segments._replace(actions=segments.actions.flip(0))
    assert prior.kl(segments).item() < 0.5
    assert prior.kl(shuffled).item() > prior.kl(segments).item() + 1.0
    assert prior.judged(segments)["transition_r2"] > 0.95
