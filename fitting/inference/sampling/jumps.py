"""Jumps between islands: proposals drawn around all of them, wherever a walker is.

Differential evolution moves a walker by the difference of two others, which seldom leads from an
island to a place on another one that is as good. Here proposals are independent of the walker
(Tierney 1994, section 2.3.3), from t distributions around the islands that the chain has shown.
They are learnt anew whenever the chain is twice as long, so that they settle (Chimisov, Latuszynski
and Roberts, Air Markov chain Monte Carlo, 2018), and follow from the chain alone: a resumed chain
makes the same proposals.
"""

import math

import emcee
import numpy as np

from .chain import Chain
from .islands import Islands, find_islands

FIRST = 100  # steps of the sampler before the first jump


class JumpMove(emcee.moves.MHMove):
    """Independent proposals around the islands that the later half of a chain shows."""

    def __init__(self, chain: Chain):
        super().__init__(self._proposals)
        self._chain = chain
        self._learnt_from = 0  # stored steps
        self._islands: Islands | None = None
        self._before = emcee.moves.DEMove(gamma0=1.0)

    def propose(self, model, state):
        """A jump of every walker; before the first lesson, whole differences of two walkers."""
        length = lesson(len(self._chain), self._chain.identity.thin_by)
        if not length:
            return self._before.propose(model, state)
        if length != self._learnt_from:
            self._learnt_from = length
            self._islands = find_islands(self._chain.u[length // 2 : length])
        return super().propose(model, state)

    def _proposals(
        self, u: np.ndarray, random: np.random.RandomState
    ) -> tuple[np.ndarray, np.ndarray]:
        """New positions, and the log-ratios of their densities."""
        assert self._islands is not None
        proposed = self._islands.draw(random, len(u))
        return proposed, self._islands.log_density(u) - self._islands.log_density(proposed)


def lesson(stored: int, thin_by: int) -> int:
    """How many stored steps the proposals are learnt from: a power of two times the first ones."""
    first = math.ceil(FIRST / thin_by)
    return first << int(math.log2(stored / first)) if stored >= first else 0
