"""Every preset on random grounds and in random states: what a viewer notices, and exceptions.

The quick sibling is in `test_stairs`, whose program it shares.
"""

from typing import NamedTuple

import numpy as np
import pytest

import jaxik
from stairs import grounds, states
from stairs.__main__ import BOUNDS
from stairs.grounds import Ground
from stairs.states import Motion
from stairs.walks import Verdict, walked, walks
from support.clips import make_rig, to_rig


class Exceptions(NamedTuple):
    """What else is allowed of a preset, with the reason."""

    reason: str
    kinds: dict[str, Verdict]
    """m, by kind of ground."""


ON_GROUND = {
    "stride": Exceptions(
        "a rolling sole is over a gap as wide as what it could slide by; a swing of 0.4 s goes "
        "over a bench of 30 cm",
        {
            "gaps": BOUNDS._replace(off=0.07),
            "furniture": BOUNDS._replace(pop=0.06, dip=0.015, bend=0.12),
        },
    ),
    "record": Exceptions(
        "one ray below each foot meets an edge once the foot is over it; nothing tells the next "
        "foothold",
        {
            "rubble": BOUNDS._replace(off=0.035, dip=0.03),
            **dict.fromkeys(("curb", "ledge"), Verdict(0.30, 0.18, 0.20, 0.30, np.inf)),
            **dict.fromkeys(("roots", "gaps"), Verdict(0.45, 0.20, 0.35, 0.40, np.inf)),
            "furniture": Verdict(0.40, 0.15, 0.32, 0.30, np.inf),
        },
    ),
    "ozz": Exceptions(
        "all feet are on the ground below them, at once and without memory",
        {
            **dict.fromkeys(("rubble", "ramp"), BOUNDS._replace(off=0.05, dip=0.05)),
            **dict.fromkeys(("curb", "ledge", "roots"), Verdict(0.30, 0.35, 0.20, 0.50, np.inf)),
            **dict.fromkeys(("gaps", "furniture"), Verdict(1.0, 0.90, 0.90, 1.60, np.inf)),
        },
    ),
    "unreal": Exceptions(
        "no foot IK while it walks; the root follows the way, and falls into gaps",
        {
            **dict.fromkeys(("rubble", "roots"), BOUNDS._replace(off=0.08)),
            "ramp": BOUNDS._replace(off=0.15, dip=0.02),
            **dict.fromkeys(
                ("curb", "ledge", "furniture", "gaps"), Verdict(0.60, 0.08, 0.18, 0.08, np.inf)
            ),
        },
    ),
    "mec": Exceptions(
        "a foot that is not low and slow stays as animated; its rays fall into gaps",
        {
            **dict.fromkeys(("rubble", "roots"), BOUNDS._replace(off=0.08, dip=0.02)),
            "ramp": BOUNDS._replace(off=0.12, dip=0.04),
            **dict.fromkeys(
                ("curb", "ledge", "furniture", "gaps"), Verdict(0.60, 0.40, 0.40, 0.25, np.inf)
            ),
        },
    ),
}

NOTICED = Motion(pop=0.025, body=0.02, far=0.20)
"""m, of a character whose feet keep their places on terraces of up to 12 cm."""
IN_STATES = dict.fromkeys(ON_GROUND, NOTICED) | {
    # While both legs hardly count, the body goes with the one that counts more.
    "stride": NOTICED._replace(pop=0.04, body=0.04),
    # As in the original, its pelvis closes a quarter of its gap of up to 12 cm in 1/60 s.
    "unreal": NOTICED._replace(pop=0.03, body=0.03),
    # A squatter on a terrace is lifted until its legs have their least length.
    "mec": NOTICED._replace(far=0.30),
}
DRAGGED = {
    # A sole lies along the side of a terrace on which its ball is, and no lock holds it.
    "stride": Motion(pop=0.25, body=0.09, far=0.42),
    # A lock lets go, and the foot goes to where it is animated.
    "record": Motion(pop=0.06, body=0.02, far=0.32),
    # Feet without memory are at once where the ground is.
    "ozz": Motion(pop=0.18, body=0.18, far=0.25),
    "unreal": NOTICED,
    "mec": NOTICED._replace(far=0.25, pop=0.03),  # its legs stretch before they let go
}
"""m, where the animation drags feet over the sides of terraces."""


def beyond(preset: str, count: int) -> list[tuple[Ground, Verdict]]:
    """The random grounds on which a walk is beyond what is allowed."""
    rng, ik = np.random.default_rng(0), getattr(jaxik.presets, preset)(walks()[0].clip.rig)
    kinds = ON_GROUND[preset].kinds
    return [
        (ground, verdict)
        for ground, verdict in walked(ik, [grounds.sample(rng) for _ in range(count)])
        if isinstance(ground, Ground) and np.any(np.array(verdict) > kinds.get(ground.kind, BOUNDS))
    ]


@pytest.mark.slow
@pytest.mark.parametrize("preset", ON_GROUND)
def test_feet_stand_on_three_hundred_grounds_but_for_what_a_preset_cannot(preset: str):
    assert not beyond(preset, 300)


@pytest.mark.slow
@pytest.mark.parametrize("preset", IN_STATES)
def test_no_state_makes_a_character_pop(preset: str):
    """Two hundred of them: sitting, crouching, dragged, turning, in the air, with half a weight."""
    rng, ik = np.random.default_rng(0), getattr(jaxik.presets, preset)(to_rig(make_rig()))
    for _ in range(200):
        state = states.sample(rng)
        motion = states.motion_of(ik, state)
        bounds = (DRAGGED if state.kind in ("push", "yaw") else IN_STATES)[preset]
        assert np.all(np.array(motion) < bounds), (state.kind, motion)
