"""SOLAR, Algorithm 1: latents with a Bayesian linear dynamical system as their prior.

What is learned: the recognition and observation networks, the variational factors over latent
dynamics, and a time-varying linear-Gaussian policy on latents. Ablations plug another prior or
another model into the same page.
"""

from __future__ import annotations

from solar_cli.control.lqr import improve_policy
from solar_cli.experience import Experience
from solar_cli.methods.local import LocalLearner
from solar_cli.models.priors import Prior
from solar_cli.models.smoothing import linear_dynamics
from solar_cli.settings.local import Solar as SolarSettings


class Solar(LocalLearner):
    """SOLAR on one cell."""

    def make_prior(self) -> Prior:
        """The prior over latents that the representation is trained with (Eq. 2 and 3)."""
        assert isinstance(self.settings, SolarSettings)
        return linear_dynamics(self.settings.dynamics, self.latent, self.task, self.device)

    def iterate(self, experience: Experience) -> dict[str, float]:
        """One turn of Algorithm 1 (lines 4 to 8)."""
        region = self.collect_and_judge(experience)  # line 4: of the newest, or the best
        lesson = self.to_learn_from(experience, region)

        model = self.representation.update(experience)  # line 5: MODELUPDATE, section 3
        states = self.embedded(lesson)

        previous = self.linearised(region, states.own)  # line 6: LINEARIZEPOLICY, appendix C
        dynamics = self.infer_dynamics(  # line 7: INFERDYNAMICS, section 4.1 and appendix B
            states.newest,
            states.older,
            self.latent_prior(lesson),
            self.streams.under("local dynamics", experience.iteration),
        )
        cost = self.fitted_cost(states.newest, states.older)  # the quadratic cost of section 3
        bound = self.max_kl(region, len(dynamics.model.F))
        update = improve_policy(  # line 8: POLICYUPDATE, section 4.2 and appendix A
            previous.policy, dynamics.model, cost.model, bound, self.std_bounds()
        )
        return {
            **model,
            **dynamics.metrics,
            **cost.metrics,
            **self.checked(states.own, states.older),
            "linearisation_residual": previous.residual,
            **self.adopt(
                region, previous.policy, update, (dynamics.model, cost.model), states.own.reached
            ),
        }
