"""The matrix-normal inverse-Wishart (MNIW) belief about a linear-Gaussian map y = F x + noise.

    S ~ IW(Psi, nu),   F | S ~ MN(M, S (rows), V (columns)),   y | x, F, S ~ N(F x, S)

It is conjugate: pairs (x, y) add their sufficient statistics to its natural parameters
(A, B, C, nu) = (Psi + M V^-1 M^T, M V^-1, V^-1, nu). ``RegressionStatistics`` holds either.
In SOLAR y is the next latent and x = [z; a], or [z; a; 1] for an affine map (Eq. 2-3, 5).

Axes: N samples, d outputs (latent), p regressors; samples are summed over the axis before the last.
Leading axes (time steps, folds) are batch axes, and broadcast. Everything is computed in float64:
conversions between the two forms lose half of the digits. Matrices that are not positive definite
raise ``torch.linalg.LinAlgError``.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from solar_cli.inference import cholesky, inverse_wishart


class RegressionStatistics(NamedTuple):
    """Sums over pairs (x, y); equally the natural parameters (A, B, C, nu) of an MNIW."""

    yy: Float[Tensor, "*batch d d"]
    yx: Float[Tensor, "*batch d p"]
    xx: Float[Tensor, "*batch p p"]
    n: Float[Tensor, "*batch"]

    def plus(self, other: RegressionStatistics) -> RegressionStatistics:
        """The statistics of both sets of pairs; batch axes broadcast.

        Natural parameters of a prior plus statistics are those of the posterior: Bayesian linear
        regression, appendix B, with nu_t = nu' + N and V_t = (V'^-1 + sum x x^T)^-1, which it
        misprints.
        """
        return RegressionStatistics(*(a + b for a, b in zip(self, other, strict=True)))

    def scaled(self, weight: float | Float[Tensor, "*batch"]) -> RegressionStatistics:
        """Every pair counted ``weight`` times."""
        w = torch.as_tensor(weight, dtype=self.n.dtype, device=self.n.device)
        matrix = w[..., None, None]
        return RegressionStatistics(
            self.yy * matrix, self.yx * matrix, self.xx * matrix, self.n * w
        )

    def at(self, members: Int[Tensor, " some"]) -> RegressionStatistics:
        """Those of some members of the last batch axis; a part without it is of every member."""
        yy, yx, xx = (part if part.ndim == 2 else part[..., members, :, :] for part in self[:3])
        n = self.n if self.n.ndim == 0 else self.n[..., members]
        return RegressionStatistics(yy, yx, xx, n)


class MNIW(NamedTuple):
    """Standard parameters: E[F] = M, E[S^-1] = nu Psi^-1; proper for nu > d - 1."""

    Psi: Float[Tensor, "*batch d d"]
    nu: Float[Tensor, "*batch"]
    M: Float[Tensor, "*batch d p"]
    V: Float[Tensor, "*batch p p"]


class ExpectedStatistics(NamedTuple):
    """Expectations of an MNIW that the ELBO needs."""

    precision: Float[Tensor, "*batch d d"]  # E[S^-1]
    precision_F: Float[Tensor, "*batch d p"]  # E[S^-1 F]  # noqa: N815
    F_precision_F: Float[Tensor, "*batch p p"]  # E[F^T S^-1 F]
    log_det_precision: Float[Tensor, "*batch"]  # E log|S^-1|


def natural(q: MNIW) -> RegressionStatistics:
    """Natural parameters of a belief."""
    C = cholesky.inverse(q.V)
    B = q.M @ C
    return RegressionStatistics(q.Psi + B @ q.M.mT, B, C, q.nu)


def standard(parameters: RegressionStatistics) -> MNIW:
    """The belief with these natural parameters."""
    L_xx, M, Psi = _regression(parameters)
    whitening = cholesky.inverse_factor(L_xx)
    return MNIW(Psi, parameters.n, M, whitening.mT @ whitening)


def _regression(parameters: RegressionStatistics) -> tuple[Tensor, Tensor, Tensor]:
    """The Cholesky factor of C, the slopes B C^-1, and Psi = A - B C^-1 B^T.

    One Cholesky factor of [[C, B^T], [B, A]] gives Psi as a product of its lower right block, so
    that it stays positive definite where the subtraction would not.
    """
    p = parameters.xx.shape[-1]
    factor = _joint_factor(parameters)
    L_xx, L_yx, L_yy = factor[..., :p, :p], factor[..., p:, :p], factor[..., p:, p:]
    M = torch.linalg.solve_triangular(L_xx, L_yx, upper=False, left=False)
    return L_xx, M, L_yy @ L_yy.mT


def _joint_factor(parameters: RegressionStatistics) -> Float[Tensor, "*batch pd pd"]:
    """The Cholesky factor of [[C, B^T], [B, A]]."""
    A, B, C, _ = parameters
    joint = torch.cat([torch.cat([C, B.mT], -1), torch.cat([B, A], -1)], -2)
    factor: Tensor = torch.linalg.cholesky(joint)
    return factor


def kl_divergence(q: MNIW, p: MNIW) -> Float[Tensor, "*batch"]:
    """KL(q || p) in nats: the global KL term of the ELBO, a value for each time step."""
    d, regressors = q.M.shape[-2:]
    V_p = torch.linalg.cholesky(p.V)
    difference = torch.linalg.solve_triangular(V_p.mT, q.M - p.M, upper=True, left=False)
    mean_shift: Tensor = q.nu * (difference * torch.linalg.solve(q.Psi, difference)).sum((-2, -1))
    trace = torch.cholesky_solve(q.V, V_p).diagonal(dim1=-2, dim2=-1).sum(-1)
    log_ratio = inverse_wishart.log_determinant(p.V) - inverse_wishart.log_determinant(q.V)
    conditional = ((trace - regressors + log_ratio) * d + mean_shift) / 2
    return inverse_wishart.kl_divergence(q.Psi, q.nu, p.Psi, p.nu) + conditional


def expected_statistics(parameters: RegressionStatistics) -> ExpectedStatistics:
    """E_q of the precision, of its products with F, and of its log-determinant.

    The lower rows of the inverse Cholesky factor of [[C, B^T], [B, A]] are Psi^-1/2 [-M, I].
    """
    d, p, nu = parameters.yy.shape[-1], parameters.xx.shape[-1], parameters.n
    whitening = cholesky.inverse_factor(_joint_factor(parameters))
    x, y = whitening[..., p:, :p], whitening[..., p:, p:]
    columns = whitening[..., :p, :p]
    scaled_y = nu[..., None, None] * y.mT
    log_det_Psi = cholesky.log_determinant(y).neg()
    return ExpectedStatistics(
        precision=scaled_y @ y,
        precision_F=-(scaled_y @ x),
        F_precision_F=nu[..., None, None] * (x.mT @ x) + d * (columns.mT @ columns),
        log_det_precision=inverse_wishart.expected_log_det_precision(log_det_Psi, d, nu),
    )


def regression_statistics(
    x: Float[Tensor, "*batch N p"],
    y: Float[Tensor, "*batch N d"],
    x_variance: Float[Tensor, "*batch N p"] | None = None,
    y_variance: Float[Tensor, "*batch N d"] | None = None,
    weights: Float[Tensor, "*batch N"] | None = None,
) -> RegressionStatistics:
    """Expected sufficient statistics of N pairs, summed over the sample axis; differentiable.

    The variances are the diagonals of a mean-field q (Eq. 5), under which x and y are independent;
    ``weights`` counts pairs (0 masks one out).
    """
    joint = torch.cat([y.double(), x.double()], dim=-1)
    w = torch.ones_like(joint[..., 0]) if weights is None else weights.double()
    moments = (w[..., None] * joint).mT @ joint
    if x_variance is not None or y_variance is not None:
        spread = torch.cat(
            [
                torch.zeros_like(mean) if variance is None else variance.double()
                for mean, variance in ((y, y_variance), (x, x_variance))
            ],
            dim=-1,
        )
        moments = moments + torch.diag_embed((w[..., None, :] @ spread).squeeze(-2))
    d = y.shape[-1]
    yy, yx, xx = moments[..., :d, :d], moments[..., :d, d:], moments[..., d:, d:]
    return RegressionStatistics(yy, yx, xx, w.sum(-1).expand(xx.shape[:-2]))


def expected_transition_kl(
    expected: ExpectedStatistics,
    pairs: RegressionStatistics,
    log_variance: Float[Tensor, "*batch"],
) -> Float[Tensor, "*batch"]:
    """Sum over pairs of E_q(F,S) E_q(x) KL(N(y_mean, diag y_variance) || N(F x, S)) in nats.

    The latent KL term of the ELBO (section 3), with the uncertainty of F, S and x in it. ``pairs``
    are the expected statistics of the pairs' mean-field factors, ``log_variance`` is the sum of the
    logarithms of all y_variance; both weigh pairs alike. Differentiable in both.
    """
    precision, precision_F, F_precision_F, log_det_precision = expected
    quadratic: Tensor = (
        (precision * pairs.yy).sum((-2, -1))
        - 2 * (precision_F * pairs.yx).sum((-2, -1))
        + (F_precision_F * pairs.xx).sum((-2, -1))
    )
    constant = pairs.n * (log_det_precision + pairs.yy.shape[-1])
    return (quadratic - constant - log_variance) / 2


def natural_gradient_step(
    current: RegressionStatistics,
    prior: RegressionStatistics,
    batch_statistics: RegressionStatistics,
    scale: float,
    rate: float,
) -> RegressionStatistics:
    """lambda + rate (lambda_0 + scale E_q[t(batch)] - lambda), on natural parameters.

    Eq. 6 prints the statistics of (F, S) where the expected statistics of the *data* belong.
    ``scale`` is the data's size over the batch's, so at rate 1 on all data (scale 1) the step is
    the closed form, the conjugate posterior.
    """
    target = prior.plus(batch_statistics.scaled(scale))
    return current.scaled(1 - rate).plus(target.scaled(rate))


def point_estimate(
    parameters: RegressionStatistics,
) -> tuple[Float[Tensor, "*batch d p"], Float[Tensor, "*batch d d"]]:
    """F = M and Sigma = Psi / nu of section 4.1, which is (E[S^-1])^-1 and not the mode."""
    _, M, Psi = _regression(parameters)
    return M, Psi / parameters.n[..., None, None]


def centred(statistics: RegressionStatistics, constant: int) -> RegressionStatistics:
    """The statistics without the constant-1 regressor at index ``constant``.

    Its intercept is integrated out under a flat prior (a Schur complement, and one sample less), so
    that the slopes of several time steps can be pooled while each keeps its own means. A time
    step without data stays empty.
    """
    yy, yx, xx, n = statistics
    constant = constant % xx.shape[-1]
    keep = [i for i in range(xx.shape[-1]) if i != constant]
    count = xx[..., constant, constant, None, None]
    count = torch.where(count > 0, count, 1.0)
    x_sum, y_sum = xx[..., keep, constant, None], yx[..., constant, None]
    return RegressionStatistics(
        yy - y_sum @ y_sum.mT / count,
        yx[..., keep] - y_sum @ x_sum.mT / count,
        xx[..., keep, :][..., keep] - x_sum @ x_sum.mT / count,
        (n - 1).clamp(min=0),
    )
