"""Random flights of stairs, the quick sibling of `python -m stairs`, and a few other grounds."""

from collections.abc import Sequence

import numpy as np
import pytest

import jaxik
from stairs import grounds
from stairs.__main__ import BOUNDS
from stairs.flights import Flight, sample
from stairs.walks import Verdict, walked


def beyond(chosen: Sequence[Flight]) -> list[tuple[Flight, Verdict]]:
    """Those on which a walk by `stride` is beyond its bounds."""
    verdicts = walked(jaxik.presets.stride(), chosen)
    return [pair for pair in verdicts if np.any(np.array(pair[1]) > BOUNDS)]


def test_feet_stand_on_treads_and_swing_in_one_arc_on_thirty_random_flights():
    """Heightfields alone, by the program of the suite; the program of stairs has meshes, too."""
    rng = np.random.default_rng(0)
    assert not beyond([sample(rng, field=True) for _ in range(30)])


def test_they_do_so_on_rubble_curbs_ledges_and_ramps():
    rng, kinds = np.random.default_rng(0), ("rubble", "curb", "ledge", "ramp")
    chosen = [ground for ground in (grounds.sample(rng) for _ in range(20)) if ground.kind in kinds]
    assert len(chosen) >= 10
    assert not beyond(chosen[:10])


@pytest.mark.slow
def test_feet_stand_on_treads_that_nothing_foretells():
    """From the first stride on; one walk of eight bends more, one of forty dips."""
    rng = np.random.default_rng(0)
    chosen = [sample(rng, field=True) for _ in range(500)]
    pairs = walked(jaxik.presets.stride(foretold=False), chosen, known=False)
    verdicts = np.array([verdict for _, verdict in pairs])
    share = (verdicts <= np.array(BOUNDS)).mean(0)
    assert (share >= Verdict(off=0.99, pop=0.96, dip=0.96, bend=0.85, sunk=1.0)).all()
    assert (verdicts[:, 1:4] <= [0.05, 0.06, 0.10]).all()
