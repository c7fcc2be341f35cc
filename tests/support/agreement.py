"""Comparison of a system with its NumPy reference, output by output."""

from collections.abc import Mapping
from typing import Any

import numpy as np

import jaxik
from reference.sample_poses import rotation_angle

JOINTS = ("hip", "knee", "ankle", "toe")
POSITION = 1e-5  # m
ANGLE = 1e-4  # rad


def assert_agreement(
    result: jaxik.Result, expected: Mapping[str, np.ndarray], outputs: Mapping[str, Any]
) -> None:
    """Asserts that joints, body and further outputs are those of the reference.

    Args:
        result: of a clip.
        expected: what the reference's `run` returns.
        outputs: ours under the reference's names; decisions have to be the same.
    """
    places = {f"{joint}_pos": getattr(result.pose, joint).pos for joint in JOINTS}
    for name, actual in ({"body_pos": result.body.pos} | places | dict(outputs)).items():
        theirs = expected[name]
        if theirs.dtype == bool:
            np.testing.assert_array_equal(np.asarray(actual) > 0.5, theirs, err_msg=name)
        else:
            close = np.testing.assert_allclose
            close(np.asarray(actual), theirs, rtol=0, atol=POSITION, err_msg=name)
    rots = {f"{joint}_rot": getattr(result.pose, joint).rot for joint in JOINTS}
    for name, rot in (rots | {"body_rot": result.body.rot}).items():
        if name in expected:
            assert rotation_angle(np.asarray(rot), expected[name]) < ANGLE, name
