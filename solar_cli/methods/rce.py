"""The E2C-like ablation (section 6): Algorithm 1 on robust locally linear controllable embedding."""

from __future__ import annotations

from solar_cli.methods.solar import Solar
from solar_cli.models.controllable_embedding import ControllableEmbedding
from solar_cli.models.priors import Prior
from solar_cli.settings.local import Rce as RceSettings


class Rce(Solar):
    """RCE with SOLAR's policy update on one cell."""

    def make_prior(self) -> Prior:
        """The transition network and the recognition network of its bound."""
        assert isinstance(self.settings, RceSettings)
        streams = self.streams.under("transitions")
        return ControllableEmbedding(
            self.settings.transition, self.latent, self.task, streams, self.device
        )
