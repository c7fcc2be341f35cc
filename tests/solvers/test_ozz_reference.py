"""The two-bone leg and the aim of the NumPy references, compared with ozz-animation."""

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from reference import maths
from reference.maths import Array
from reference.sample_poses import rotation_angle
from reference.stages import pole
from reference.systems import ozz

STRIDE = 20  # of the rows of a table, one in so many is tried
FORMULAS = 2e-6  # rad, compared with the same formulas in 64 bits on the table's 32-bit axes


def rows(path: Path, without: str) -> Iterator[dict[str, Array]]:
    """Well-conditioned rows of a table of ozz's results, without those of one category."""
    with np.load(path) as file:
        table = {name: file[name] for name in file.files}
    category = table["category_names"][table["category"]]
    for row in np.flatnonzero(table["well_conditioned"] & (category != without))[::STRIDE]:
        yield {
            name: np.asarray(column[row], float)
            for name, column in table.items()
            if len(column) == len(category) and column.dtype.kind in "fb"
        }


def in_joint_space(matrix: Array, row: dict[str, Array]) -> tuple[Array, Array, Array, Array]:
    """Linear part and offset of a joint's inverse matrix; target and pole in the joint's space."""
    inverse = np.asarray(np.linalg.inv(matrix), np.float64)
    linear, offset = inverse[:3, :3], inverse[:3, 3]
    return linear, offset, linear @ row["target"] + offset, linear @ row["pole_vector"]


def weighted(rot: Array, weight: Array) -> Array:
    return maths.nlerp(maths.IDENTITY, rot, float(weight))


def test_two_bones_agree_with_ozz_in_double_precision(shared: Path):
    tried = 0
    for row in rows(shared / "golden" / "ozz_two_bone.npz", without=""):
        linear, offset, target, direction = in_joint_space(row["start"], row)
        knee, ankle = (linear @ row[name][:3, 3] + offset for name in ("mid", "end"))
        hinge = maths.unit(linear @ row["mid"][:3, :3] @ row["mid_axis"], maths.X)
        soften, twist = float(row["soften"]), float(row["twist_angle"])
        hip_rot, knee_rot, in_reach = pole.joint_rotations(
            knee, ankle, hinge, target, direction, soften, twist
        )
        assert (
            rotation_angle(weighted(hip_rot, row["weight"]), np.roll(row["start_ref64"], 1))
            < FORMULAS
        )
        # The same angle about the axis in the knee's own space.
        sine = float(knee_rot[1:] @ hinge)
        knee_rot = np.concatenate([knee_rot[:1], sine * maths.unit(row["mid_axis"], maths.X)])
        assert (
            rotation_angle(weighted(knee_rot, row["weight"]), np.roll(row["mid_ref64"], 1))
            < FORMULAS
        )
        assert (in_reach and row["weight"] >= 1.0) == row["reached"]
        tried += 1
    assert tried > 100


def test_aim_agrees_with_ozz_in_double_precision(shared: Path):
    tried = 0
    # Ozz treats nearly opposite directions as opposite.
    for row in rows(shared / "golden" / "ozz_aim.npz", without="opposite"):
        _, _, target, direction = in_joint_space(row["joint"], row)
        axes, twist = (row["forward"], row["offset"], row["up"]), float(row["twist_angle"])
        rot, reached = ozz.aim(*axes, target, direction, twist)
        expected = np.roll(row["correction_ref64_shortest"], 1)
        assert rotation_angle(weighted(rot, row["weight"]), expected) < FORMULAS
        assert reached == row["reached"]
        tried += 1
    assert tried > 100


def test_softening_follows_its_curve():
    assert pole.softened(0.7, 0.8, 1.0) == 0.7
    assert pole.softened(1.0, 0.8, 1.0) == pytest.approx(0.8 + 0.2 * (1 - 0.75**4))
    assert pole.softened(5.0, 1.0, 1.0) == 5.0


@pytest.mark.parametrize("fraction, reached", [(0.99, True), (1.01, False)])
def test_a_target_is_reached_up_to_the_full_length_of_the_leg(fraction, reached):
    knee, ankle = np.array([0.0, -0.4, 0.2]), np.array([0.0, -0.8, 0.0])
    target = -fraction * 2 * math.hypot(0.4, 0.2) * maths.Y
    assert pole.joint_rotations(knee, ankle, -maths.X, target, maths.Z, 1.0, 0.0)[2] == reached


def test_a_target_on_the_hip_and_a_pole_along_the_target_have_an_answer():
    knee, ankle = np.array([0.0, -0.4, 0.2]), np.array([0.0, -0.8, 0.0])
    hip_rot, knee_rot, reached = pole.joint_rotations(
        knee, ankle, -maths.X, np.zeros(3), maths.Z, 1.0, 0.0
    )
    assert (hip_rot == maths.IDENTITY).all() and not reached
    folded = knee + maths.rotate(knee_rot, ankle - knee)
    assert np.allclose(folded, 0.0, atol=1e-9)
    along = pole.joint_rotations(knee, ankle, -maths.X, 0.7 * -maths.Y, maths.Y, 1.0, 0.0)[0]
    assert maths.rotate(along, maths.X) == pytest.approx(maths.X)
