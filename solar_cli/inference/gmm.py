"""LQR-FLM's local dynamics: a Gaussian a time step under a mixture prior (Levine & Abbeel 2014).

A Gaussian mixture over the points (x, u, x') of all time steps tells what transitions look like in
general; at each time step the clusters that explain its points give a normal-inverse-Wishart prior;
the joint Gaussian fitted under it, conditioned on (x, u), is the affine linear-Gaussian dynamics.

EM's two steps are one matrix product each with the monomials of the points: a log density is a
quadratic, and scatters are sums of products. Points are centred first: far from zero, what a
quadratic is made of cancels, and its digits are lost.

Axes: K clusters, P points in all, T time steps, N points a time step, D = p + d dimensions of a
point (p regressors, then d outputs), q monomials of one. float64.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from solar_cli.inference import cholesky, quadratics

# The numbers are the defaults of gps (cbfinn/gps), but for the ridge: it is relative to the data's
# own variances here, so that a change of units changes nothing.
POINTS_PER_CLUSTER, FEWEST_CLUSTERS, MOST_CLUSTERS = 40, 2, 20
COVARIANCE_RIDGE = 1e-6  # of each dimension's variance
ITERATIONS = 100
TOLERANCE = 1e-5  # nats a point: what EM must gain to go on
PRIOR_STRENGTH = 1.0  # m: pseudo-counts of the prior


class GaussianMixture(NamedTuple):
    """Full-covariance Gaussian mixture and the number of points it was fitted to."""

    weights: Float[Tensor, " K"]
    means: Float[Tensor, "K D"]
    covariances: Float[Tensor, "K D D"]
    points: int


class MixtureFit(NamedTuple):
    """A fitted mixture and its log posterior in nats at each EM iteration, which never falls."""

    mixture: GaussianMixture
    log_posterior: list[float]


class LocalPrior(NamedTuple):
    """NIW prior at each time step: m pseudo-points with mean mu0, and scatter Phi of n0 of them."""

    mu0: Float[Tensor, "T D"]
    Phi: Float[Tensor, "T D D"]
    m: float
    n0: float


class JointGaussian(NamedTuple):
    """Gaussian of a point at each time step."""

    mean: Float[Tensor, "T D"]
    covariance: Float[Tensor, "T D D"]


class AffineGaussian(NamedTuple):
    """y | x ~ N(F x + f, Sigma) at each time step."""

    F: Float[Tensor, "T d p"]
    f: Float[Tensor, "T d"]
    Sigma: Float[Tensor, "T d d"]


def cluster_count(points: int) -> int:
    """Clusters for a data set of that size: one for 40 points, within 2 and 20."""
    return min(max(points // POINTS_PER_CLUSTER, FEWEST_CLUSTERS), MOST_CLUSTERS)


def fit_mixture(
    points: Float[Tensor, "P D"], clusters: int, generator: np.random.Generator
) -> MixtureFit:
    """Expectation-maximisation from k-means++ seeds; the same generator state gives the same fit.

    Covariances carry a weak inverse-Wishart prior at the data's own variances, so that no cluster
    becomes singular and an empty one becomes the data's Gaussian. What EM climbs is the
    posterior under it.
    """
    points = points.double()
    centre, scale = points.mean(0), _dimension_variance(points).sqrt()
    standard = (points - centre) / scale
    x = quadratics.monomials(standard)
    pseudo_counts = COVARIANCE_RIDGE * len(points) / clusters
    responsibility = _seed_responsibilities(standard, clusters, generator)
    log_posterior: list[float] = []
    for _ in range(ITERATIONS):
        mixture = _maximise(x, responsibility, pseudo_counts)
        joint = x @ _log_joint(mixture).mT
        log_likelihood = joint.logsumexp(-1).sum() - len(points) * scale.log().sum()
        log_posterior.append(float(log_likelihood + _log_prior(mixture, pseudo_counts)))
        if len(log_posterior) > 1 and (
            log_posterior[-1] - log_posterior[-2] < TOLERANCE * len(points)
        ):
            break
        responsibility = joint.softmax(-1)
    mixture = mixture._replace(
        means=centre + scale * mixture.means,
        covariances=scale[:, None] * mixture.covariances * scale,
    )
    return MixtureFit(mixture, log_posterior)


def responsibilities(
    mixture: GaussianMixture, points: Float[Tensor, "*batch D"]
) -> Float[Tensor, "*batch K"]:
    """Posterior probability of each cluster at each point."""
    centre = mixture.weights @ mixture.means
    x = quadratics.monomials(points.double() - centre)
    return (x @ _log_joint(mixture._replace(means=mixture.means - centre)).mT).softmax(-1)


def local_prior(
    mixture: GaussianMixture,
    points: Float[Tensor, "T N D"],
    weights: Float[Tensor, "T N"] | None = None,
) -> LocalPrior:
    """The moments of the clusters that explain the points of a time step.

    ``weights`` counts points (0 masks one out).
    """
    w = torch.ones_like(points[..., 0]) if weights is None else weights.double()
    shares = (responsibilities(mixture, points) * w[..., None]).sum(-2) / w.sum(-1)[:, None]
    mu0 = shares @ mixture.means
    spread = mixture.means - mu0[:, None]
    within = torch.einsum("tk,kij->tij", shares, mixture.covariances)
    between = torch.einsum("tk,tki,tkj->tij", shares, spread, spread)
    freedom = (mixture.points - 2 - mu0.shape[-1]) / mixture.points
    return LocalPrior(
        mu0,
        PRIOR_STRENGTH * (within + between),
        PRIOR_STRENGTH,
        PRIOR_STRENGTH * max(freedom, 0.0),
    )


def fit_joint(
    points: Float[Tensor, "T N D"], prior: LocalPrior, weights: Float[Tensor, "T N"] | None = None
) -> JointGaussian:
    """The Gaussian of each time step's points under its prior; the mean is the points' own.

    ``weights`` counts points (0 masks one out).
    """
    points = points.double()
    w = (torch.ones_like(points[..., 0]) if weights is None else weights.double())[..., None]
    count = w.sum(-2)
    mean = (points * w).sum(-2) / count
    deviation = points - mean[:, None]
    shift, count = (mean - prior.mu0)[..., None], count[..., None]
    shrinkage = count * prior.m / (count + prior.m)
    scatter = (w * deviation).mT @ deviation + prior.Phi + shrinkage * shift @ shift.mT
    return JointGaussian(mean, scatter / (count + prior.n0))


def condition_joint(joint: JointGaussian, regressors: int) -> AffineGaussian:
    """The last D - p dimensions given the first p = ``regressors``."""
    p, (mean, covariance) = regressors, joint
    variance = covariance.diagonal(dim1=-2, dim2=-1)[..., :p]
    xx = covariance[..., :p, :p] + torch.diag_embed(COVARIANCE_RIDGE * variance)
    yx, yy = covariance[..., p:, :p], covariance[..., p:, p:]
    F = torch.cholesky_solve(yx.mT, torch.linalg.cholesky(xx)).mT
    f = mean[..., p:] - (F @ mean[..., :p, None])[..., 0]
    # E of the squared residual under the joint Gaussian: positive definite whatever F is.
    residual = torch.cat(
        [-F, torch.eye(yy.shape[-1], dtype=F.dtype, device=F.device).expand_as(yy)], -1
    )
    return AffineGaussian(F, f, residual @ covariance @ residual.mT)


def _dimension_variance(points: Float[Tensor, "P D"]) -> Float[Tensor, " D"]:
    """Variance of each dimension, or 1 where it is zero but for rounding."""
    variance = points.var(0, correction=0)
    rounding = 1e-24 * points.square().mean(0)
    return torch.where(variance > rounding, variance, 1.0)


def _seed_responsibilities(
    points: Float[Tensor, "P D"], clusters: int, generator: np.random.Generator
) -> Float[Tensor, "P K"]:
    """Every point belongs to the nearest of K seeds, drawn as in k-means++."""
    values = points.cpu().numpy()
    chosen = [int(generator.integers(len(values)))]
    squared = ((values - values[chosen[0]]) ** 2).sum(-1)
    nearest = np.zeros(len(values), dtype=np.int64)
    for k in range(1, clusters):
        total = squared.sum()
        chances = squared / total if total > 0 else np.full(len(values), 1 / len(values))
        chosen.append(int(generator.choice(len(values), p=chances)))
        candidate = ((values - values[chosen[-1]]) ** 2).sum(-1)
        nearest[candidate < squared] = k
        squared = np.minimum(squared, candidate)
    hard = torch.nn.functional.one_hot(torch.from_numpy(nearest), clusters)
    return hard.to(points)


def _maximise(
    x: Float[Tensor, "P q"], responsibility: Float[Tensor, "P K"], pseudo_counts: float
) -> GaussianMixture:
    """M step of standardised points: weights, means, and the posterior mode of the covariances."""
    sums = responsibility.mT @ x
    counts = sums[:, -1].clamp(min=torch.finfo(x.dtype).tiny)
    means = sums[:, -1 - quadratics.features(x.shape[-1]) : -1] / counts[:, None]
    scatter = quadratics.outer(sums) - counts[:, None, None] * means[..., None] * means[:, None]
    prior = pseudo_counts * torch.eye(means.shape[-1]).to(x)
    covariances = (scatter + prior) / (counts + pseudo_counts)[:, None, None]
    return GaussianMixture(counts / counts.sum(), means, covariances, len(x))


def _log_joint(mixture: GaussianMixture) -> Float[Tensor, "K q"]:
    """log (weight_k N(point | cluster k)), as weights of the point's monomials."""
    factor = torch.linalg.cholesky(mixture.covariances)
    precision = torch.cholesky_inverse(factor)
    slope = (precision @ mixture.means[..., None])[..., 0]
    constant = mixture.means.shape[-1] * math.log(2 * math.pi) + cholesky.log_determinant(factor)
    at_zero = mixture.weights.log() - (constant + (slope * mixture.means).sum(-1)) / 2
    return quadratics.weights(-precision, torch.cat([slope, at_zero[:, None]], dim=-1))


def _log_prior(mixture: GaussianMixture, pseudo_counts: float) -> Tensor:
    """Log density of the covariances of standardised points under their inverse-Wishart prior, up
    to a constant.
    """
    factor = torch.linalg.cholesky(mixture.covariances)
    inverse = torch.cholesky_inverse(factor).diagonal(dim1=-2, dim2=-1)
    return (cholesky.log_determinant(factor) + inverse.sum(-1)).sum().mul(-pseudo_counts / 2)
