"""Random flights of stairs: the quick sibling of `python -m stairs`."""

import numpy as np

import jaxik
from stairs.__main__ import BOUNDS
from stairs.flights import sample
from stairs.walks import walked


def test_feet_stand_on_treads_and_swing_in_one_arc_on_thirty_random_flights():
    """Heightfields alone, which share one program; the program walks over meshes, too."""
    rng = np.random.default_rng(0)
    chosen = [sample(rng, field=True) for _ in range(30)]
    beyond = [
        (flight, verdict)
        for flight, verdict in walked(jaxik.presets.stride(), chosen)
        if np.any(np.array(verdict) > BOUNDS)
    ]
    assert not beyond
