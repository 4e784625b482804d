"""The E2C-like ablation (section 6): Algorithm 1 with robust controllable embedding as its model.

RCE (Banijamali et al. 2018, arXiv 1710.05373) learns latents whose next values a network predicts
by z' = A z + B u + o, locally linear around a place zbar that it infers, with A = I + v r^T. Its
bound is in `models/controllable_embedding.py`, the network in `models/transition.py`. The local
dynamics of line 7 are that network's slopes along the mean trajectory of the policy's episodes; its
errors there give offsets and noise. Lines 4, 6 and 8 and the rules around them are SOLAR's.

No code of the authors is published. Ours differs from their paper:

* They encode a stack of frames at once. Here each frame is encoded, as by every method, and a state
  is a window: A maps its newest latents, and differences back through the window, which carry the
  velocity, enter linearly as the action does, both being observed. An A over the whole window,
  whose older blocks are copies of others, could not be inverted.
* The network reads and moves latents in units of their std, so that its learning rate can be the
  encoder's, and q(zbar | x, z') begins as p(z | x).
* The likelihood and the schedule of the KL terms' weight are SOLAR's: only the model differs. On
  nav a weight of 1 from the start, and a small further KL to N(0, I), changed nothing.
* They train once. Where a card freezes the encoder after the first training, the two networks of
  transitions go on being fitted to the last B iterations' latents, as SOLAR's factor does.
"""

from __future__ import annotations

from solar_cli.methods.solar import Solar
from solar_cli.models.controllable_embedding import ControllableEmbedding
from solar_cli.models.priors import Prior
from solar_cli.settings.local import Rce as RceSettings


class Rce(Solar):
    """RCE with SOLAR's policy update on one cell."""

    def make_prior(self) -> Prior:
        """A network of transitions, and one for the place where they are linear."""
        assert isinstance(self.settings, RceSettings)
        streams = self.streams.under("transitions")
        return ControllableEmbedding(
            self.settings.transition, self.latent, self.task, streams, self.device
        )
