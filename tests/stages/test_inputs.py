"""What the stages read of one frame."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxik import HARD
from jaxik.stages.inputs import Inputs
from support.clips import FLAT, animate, make_rig, to_frames, to_rig, to_terrain


def test_a_faulty_leg_counts_as_one_that_is_not_there_and_no_other_does():
    rig, frames = to_rig(make_rig()), to_frames(animate(make_rig(), count=1))
    frame = jax.tree.map(lambda x: x[0], frames)
    inputs = Inputs(rig, to_terrain(FLAT), frame, HARD)
    np.testing.assert_array_equal(inputs.at(frame).rig.present, [True, True])
    for faulty in ([True, False], [False, True], [False, False]):
        present = inputs.at(frame, jnp.array(faulty)).rig.present
        np.testing.assert_array_equal(present, np.logical_not(faulty))
