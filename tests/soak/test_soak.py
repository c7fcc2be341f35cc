"""A short soak test; `python -m soak` is the long one."""

import pytest

import jaxik
from soak.live import grounds, living, newborn, summarised

BONE_ERROR = 1e-6  # m, of the quaternions of the clip, which has 32 bits


@pytest.mark.slow
def test_characters_live_through_random_faults():
    ik = jaxik.presets.record()
    _, shown = living(ik, steps=100)(newborn(ik, 20, seed=1), grounds()[0])
    findings = summarised(shown)
    assert findings.frames == 2000 and findings.faulty > 50
    assert findings.not_finite == 0
    assert findings.bone_error < BONE_ERROR
