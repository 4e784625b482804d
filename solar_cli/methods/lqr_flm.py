"""LQR-FLM (Levine and Abbeel 2014): LQR with linear models that are fitted at each time step.

Algorithm 1 without its model: states are what is observed, so that line 5 has nothing to train. A
Gaussian mixture over all transitions is the prior of each time step's normal-inverse-Wishart fit
(`solar_cli.inference.gmm`), and the KL-constrained LQR of line 8 was this method's first.

Where ours departs from the authors' release (guided policy search): the cost is not given but
fitted, as section E.2 has it; images, of which their fit cannot even be stored, are seen by their
principal components; states are whitened, so that ridges have no units; and the KL step, the
bounds of noise and the way back to the best policy are those of all local methods here. The
mixture's numbers are theirs.
"""

from __future__ import annotations

from solar_cli.methods.solar import Solar
from solar_cli.models.projection import Projection
from solar_cli.models.state_representation import StateRepresentation
from solar_cli.settings.local import LqrFlm as LqrFlmSettings


class LqrFlm(Solar):
    """LQR-FLM on one cell."""

    def make_representation(self) -> StateRepresentation:
        """States as they are observed, or principal components of images."""
        assert isinstance(self.settings, LqrFlmSettings)
        return Projection(self.settings, self.task, self.device)
