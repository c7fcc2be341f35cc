"""The references' two-bone leg with a pole and their aim, also beside ozz's answers."""

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from reference import maths, ozz, pole
from reference.maths import Array
from reference.poses import turn_angle

EVERY = 20  # rows of the tables that are tried
FORMULAS = 2e-6  # rad, to a 64-bit evaluation that takes the table's 32-bit axes as they are


def rows(path: Path, without: str) -> Iterator[dict[str, Array]]:
    """Well-conditioned rows of a table of golden answers, but for those of one category."""
    with np.load(path) as file:
        table = {name: file[name] for name in file.files}
    category = table["category_names"][table["category"]]
    for row in np.flatnonzero(table["well_conditioned"] & (category != without))[::EVERY]:
        yield {
            name: np.asarray(column[row], float)
            for name, column in table.items()
            if len(column) == len(category) and column.dtype.kind in "fb"
        }


def inside(matrix: Array, row: dict[str, Array]) -> tuple[Array, Array, Array, Array]:
    """A joint's inverse matrix's linear part and shift, and the row's target and pole in there."""
    inverse = np.asarray(np.linalg.inv(matrix), np.float64)
    turn, shift = inverse[:3, :3], inverse[:3, 3]
    return turn, shift, turn @ row["target"] + shift, turn @ row["pole_vector"]


def blended(turned: Array, weight: Array) -> Array:
    return maths.nlerp(maths.IDENTITY, turned, float(weight))


def test_two_bones_agree_with_a_double_precision_reading_of_ozz(shared: Path):
    tried = 0
    for row in rows(shared / "golden" / "ozz_two_bone.npz", without=""):
        turn, shift, target, direction = inside(row["start"], row)
        knee, ankle = (turn @ row[name][:3, 3] + shift for name in ("mid", "end"))
        hinge = maths.unit(turn @ row["mid"][:3, :3] @ row["mid_axis"], maths.X)
        soften, twist = float(row["soften"]), float(row["twist_angle"])
        hip_turn, knee_turn, in_reach = pole.turns(
            knee, ankle, hinge, target, direction, soften, twist
        )
        assert (
            turn_angle(blended(hip_turn, row["weight"]), np.roll(row["start_ref64"], 1)) < FORMULAS
        )
        # The same angle, about the axis as the knee has it.
        sine = float(knee_turn[1:] @ hinge)
        knee_turn = np.concatenate([knee_turn[:1], sine * maths.unit(row["mid_axis"], maths.X)])
        assert (
            turn_angle(blended(knee_turn, row["weight"]), np.roll(row["mid_ref64"], 1)) < FORMULAS
        )
        assert (in_reach and row["weight"] >= 1.0) == row["reached"]
        tried += 1
    assert tried > 100


def test_aim_agrees_with_a_double_precision_reading_of_ozz(shared: Path):
    tried = 0
    # Ozz takes directions that are nearly opposite for quite opposite.
    for row in rows(shared / "golden" / "ozz_aim.npz", without="opposite"):
        _, _, target, direction = inside(row["joint"], row)
        axes, twist = (row["forward"], row["offset"], row["up"]), float(row["twist_angle"])
        turned, reached = ozz.aim(*axes, target, direction, twist)
        wanted = np.roll(row["correction_ref64_shortest"], 1)
        assert turn_angle(blended(turned, row["weight"]), wanted) < FORMULAS
        assert reached == row["reached"]
        tried += 1
    assert tried > 100


def test_softening_follows_its_curve():
    assert pole.softened(0.7, 0.8, 1.0) == 0.7
    assert pole.softened(1.0, 0.8, 1.0) == pytest.approx(0.8 + 0.2 * (1 - 0.75**4))
    assert pole.softened(5.0, 1.0, 1.0) == 5.0


@pytest.mark.parametrize("share, reached", [(0.99, True), (1.01, False)])
def test_a_target_is_reached_up_to_the_legs_whole_length(share, reached):
    knee, ankle = np.array([0.0, -0.4, 0.2]), np.array([0.0, -0.8, 0.0])
    target = -share * 2 * math.hypot(0.4, 0.2) * maths.Y
    assert pole.turns(knee, ankle, -maths.X, target, maths.Z, 1.0, 0.0)[2] == reached


def test_a_target_on_the_hip_and_a_pole_along_the_target_have_an_answer():
    knee, ankle = np.array([0.0, -0.4, 0.2]), np.array([0.0, -0.8, 0.0])
    hip_turn, knee_turn, reached = pole.turns(knee, ankle, -maths.X, np.zeros(3), maths.Z, 1.0, 0.0)
    assert (hip_turn == maths.IDENTITY).all() and not reached
    folded = knee + maths.rotate(knee_turn, ankle - knee)
    assert np.allclose(folded, 0.0, atol=1e-9)
    along = pole.turns(knee, ankle, -maths.X, 0.7 * -maths.Y, maths.Y, 1.0, 0.0)[0]
    assert maths.rotate(along, maths.X) == pytest.approx(maths.X)
