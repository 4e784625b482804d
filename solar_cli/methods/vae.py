"""The VAE ablation (section 6): Algorithm 1 with a standard-normal prior over latents.

Nothing in its representation knows of dynamics, so its local dynamics are LQR-FLM's: a Gaussian
mixture over all transitions is the prior of each time step's fit.
"""

from __future__ import annotations

from solar_cli.methods.solar import Solar
from solar_cli.models.priors import Prior, StandardNormal


class Vae(Solar):
    """The VAE ablation on one cell."""

    def make_prior(self) -> Prior:
        """p(z_t) = N(0, I)."""
        return StandardNormal()
