"""Random streams keyed by what they are for, not spawned in order.

Adding a stream, an evaluation or a restart shifts no other stream, and a resumed run needs no saved
generator: the key says it all.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np

Key = str | int


@dataclass(frozen=True)
class Streams:
    """All random streams of one cell; ``prefix`` narrows them to one purpose."""

    seed: int
    prefix: tuple[Key, ...] = ()

    def under(self, *key: Key) -> Streams:
        """The streams below ``key``, to hand to a part that names its own."""
        return Streams(self.seed, (*self.prefix, *key))

    def entropy(self, *key: Key) -> int:
        """A 128-bit integer that depends on the seed and on the whole key only."""
        text = repr((self.seed, *self.prefix, *key)).encode()
        return int.from_bytes(hashlib.blake2b(text, digest_size=16).digest(), "little")

    def generator(self, *key: Key) -> np.random.Generator:
        """A fresh NumPy generator for ``key``; the same key gives the same numbers."""
        return np.random.Generator(np.random.PCG64(self.entropy(*key)))

    def seed63(self, *key: Key) -> int:
        """A seed for a foreign generator (``torch.Generator``, a simulator): 63 bits."""
        return self.entropy(*key) & (2**63 - 1)
