"""Ozz's own answers: its two-bone and aim jobs, on random rows and on the cases of its unit tests.

The tolerances are those of the table's README, for ozz's estimates of reciprocal roots are what
differs. Everything is solved in the space of the start joint, or of the joint that aims, where ozz
solves it; the test takes the matrices there, scale and mirror included, in 64-bit floats.
"""

from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.typing import DTypeLike

from jaxik.maths import quat
from jaxik.maths.gate import HARD
from jaxik.solvers import aim
from jaxik.solvers import two_bone as solver

ROTATIONS, SOFT_ROTATIONS = (8.5e-4, 1.2e-5), (3.2e-3, 1.6e-3)  # rad, hip and knee
PLACE, SOFT_PLACE = 1.1e-5, 1.3e-3  # m
AIM = 6.4e-4  # rad
FORMULAS = 2e-6  # rad, to a 64-bit evaluation that takes the table's 32-bit axes as they are
OPPOSED = 1e-6  # ozz calls directions opposed whose cosine is this near to -1
TINY = 1e-30
TARGET_MET = 1e-2  # m, the width of ozz's own tests


class Rows(dict):
    """Columns of a table, float64 where they were float32."""

    def __getattr__(self, name: str) -> np.ndarray:
        return self[name]

    def pick(self, rows: np.ndarray) -> "Rows":
        return Rows({name: x[rows] for name, x in self.items()})


def table(path: Path, edges: bool) -> Rows:
    """The random rows of a file, or its `edge_*` rows, with the prefix taken off."""
    columns = {}
    with np.load(path) as file:
        for name in file.files:
            if name.startswith("edge_") == edges and name != "category_names":
                x = file[name]
                x = x.astype(np.float64) if x.dtype == np.float32 else x
                columns[name.removeprefix("edge_")] = x
        if not edges:
            columns["category"] = file["category_names"][file["category"]]
    return Rows(columns)


def inverses(matrices: np.ndarray) -> np.ndarray:
    """Their inverses; zero, as with ozz, for a matrix that has none."""
    flat = np.linalg.det(matrices) == 0
    whole = np.where(flat[:, None, None], np.eye(4), matrices)
    return np.where(flat[:, None, None], 0.0, np.linalg.inv(whole))


def points(matrices: np.ndarray, p: np.ndarray) -> np.ndarray:
    return np.einsum("nij,nj->ni", matrices[:, :3, :3], p) + matrices[:, :3, 3]


def directions(matrices: np.ndarray, v: np.ndarray) -> np.ndarray:
    return np.einsum("nij,nj->ni", matrices[:, :3, :3], v)


def wxyz(q: np.ndarray) -> np.ndarray:
    return np.roll(q, 1, axis=-1)


def angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angle between rotations, rad, for quaternions that are only nearly unit."""
    a, b = (q / np.linalg.norm(q, axis=-1, keepdims=True) for q in (a, b))
    return np.asarray(quat.angle(jnp.asarray(a), jnp.asarray(b)))


class Answer(NamedTuple):
    """What the two-bone table holds of an answer."""

    start: np.ndarray  # rows 4, correction of the hip
    mid: np.ndarray  # rows 4, of the knee
    end: np.ndarray  # rows 3, the ankle's place, model space
    reached: np.ndarray  # rows


def blended(turn: jax.Array, rows: Rows) -> jax.Array:
    """A part of the turn; the weight, and its clamp to 0..1, are the caller's business with us."""
    weight = jnp.asarray(np.clip(rows.weight, 0.0, 1.0), turn.dtype)
    return quat.nlerp(quat.identity(turn.dtype), turn, weight)


def two_bone(rows: Rows, dtype: DTypeLike = jnp.float64) -> Answer:
    """Our answers, solved in the space of the start joint."""
    to_start = inverses(rows.start)
    knee, ankle = (points(to_start, x[:, :3, 3]) for x in (rows.mid, rows.end))
    hinge = directions(to_start, directions(rows.mid, rows.mid_axis))
    hinge = hinge / np.maximum(np.linalg.norm(hinge, axis=-1, keepdims=True), TINY)
    target = points(to_start, rows.target)
    pole = directions(to_start, rows.pole_vector)
    given = (-knee, ankle - knee, hinge, target, pole, rows.soften, rows.twist_angle)
    given = [jnp.asarray(x, dtype) for x in given]
    bend = jax.jit(lambda x: solver.pole_bend(*x, gate=HARD))(given)

    half = bend.half_cos, bend.half_sin
    start = blended(bend.swing, rows)
    mid = blended(quat.from_half_angle(jnp.asarray(rows.mid_axis, dtype), *half), rows)
    turn = blended(quat.from_half_angle(given[2], *half), rows)
    place = quat.rotate(start, quat.rotate(turn, given[1]) - given[0])
    reached = (np.asarray(bend.reached) == 1) & (rows.weight >= 1)
    end = points(rows.start, np.asarray(place, np.float64))
    return Answer(np.asarray(start), np.asarray(mid), end, reached)


def to_aim(rows: Rows) -> tuple[np.ndarray, np.ndarray]:
    """Target and pole in the space of the joint that aims."""
    to_joint = inverses(rows.joint)
    return points(to_joint, rows.target), directions(to_joint, rows.pole_vector)


def aimed(rows: Rows, dtype: DTypeLike = jnp.float64) -> tuple[np.ndarray, np.ndarray]:
    """Our corrections (rows 4), and whether the target is reached."""
    target, pole = to_aim(rows)
    given = (target, rows.forward, rows.offset, rows.up, pole, rows.twist_angle)
    given = [jnp.asarray(x, dtype) for x in given]
    turn, reached = jax.jit(lambda x: aim.aim_rotation(*x, gate=HARD))(given)
    return np.asarray(blended(turn, rows)), np.asarray(reached) == 1


def meeting_points(rows: Rows) -> tuple[np.ndarray, np.ndarray]:
    """Unit direction of the point that ozz turns onto the target, and of the target."""
    target, _ = to_aim(rows)
    along = np.vecdot(rows.forward, rows.offset)
    root = np.sqrt(np.vecdot(target, target) - np.vecdot(rows.offset, rows.offset) + along**2)
    meeting = rows.offset + rows.forward * (root - along)[:, None]
    meeting, target = (x / np.linalg.norm(x, axis=-1, keepdims=True) for x in (meeting, target))
    return meeting, target


@pytest.fixture(scope="module")
def two_bone_file(shared: Path) -> Path:
    return shared / "golden" / "ozz_two_bone.npz"


@pytest.fixture(scope="module")
def aim_file(shared: Path) -> Path:
    return shared / "golden" / "ozz_aim.npz"


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_every_well_conditioned_limb_is_bent_as_by_ozz(two_bone_file, dtype):
    rows = table(two_bone_file, edges=False)
    rows = rows.pick(rows.well_conditioned)
    assert rows.ok.all() and len(rows.ok) == 4029
    ours = two_bone(rows, dtype)
    hip = angles(ours.start, wxyz(rows.start_joint_correction))
    knee = angles(ours.mid, wxyz(rows.mid_joint_correction))
    gap = np.linalg.norm(ours.end - rows.end_position_after, axis=-1)
    soft = rows.softening_active
    assert soft.any() and not soft.all()
    for error, sharp_most, soft_most in zip(
        (hip, knee, gap), (*ROTATIONS, PLACE), (*SOFT_ROTATIONS, SOFT_PLACE), strict=True
    ):
        assert error[~soft].max() < sharp_most
        assert error[soft].max() < soft_most
    np.testing.assert_array_equal(ours.reached, rows.reached)


def test_limbs_are_bent_by_ozz_s_formulas_even_where_its_estimates_are_poor(two_bone_file):
    rows = table(two_bone_file, edges=False)
    ours = two_bone(rows)
    assert angles(ours.start, wxyz(rows.start_ref64)).max() < FORMULAS
    assert angles(ours.mid, wxyz(rows.mid_ref64)).max() < FORMULAS
    np.testing.assert_array_equal(ours.reached, rows.reached_ref64)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_no_limb_is_too_badly_conditioned_for_a_unit_answer(two_bone_file, dtype):
    rows = table(two_bone_file, edges=False)
    ours = two_bone(rows, dtype)
    eps = np.finfo(dtype).eps
    for q in ours.start, ours.mid:
        np.testing.assert_allclose(np.linalg.norm(q, axis=-1), 1.0, rtol=0, atol=8 * eps)
    assert np.isfinite(ours.end).all()


def test_the_limbs_of_ozz_s_unit_tests_do_what_those_tests_expect(two_bone_file):
    rows = table(two_bone_file, edges=True)
    # Ozz refuses to run on a hinge that is not of unit length. We ask for one in the docstring, and
    # no function of a step raises: here the test's own change of space has made it unit.
    assert rows.name[~rows.expect_ok].tolist() == ["JobValidity/unnormalized_mid_axis"]
    ours = two_bone(rows)
    assert all(np.isfinite(x).all() for x in ours)
    met = np.linalg.norm(ours.end - rows.target, axis=-1) < TARGET_MET
    hip = angles(ours.start, wxyz(rows.expect_start))
    knee = angles(ours.mid, wxyz(rows.expect_mid))
    for i, name in enumerate(rows.name):
        if rows.expect_start_on[i]:
            assert hip[i] < rows.expect_tol[i], name
        if rows.expect_mid_on[i]:
            assert knee[i] < rows.expect_tol[i], name
        if rows.expect_fk_reached[i] >= 0:
            assert met[i] == rows.expect_fk_reached[i], name
        if rows.expect_reached[i] >= 0:
            assert ours.reached[i] == rows.expect_reached[i], name
    np.testing.assert_array_equal(ours.reached[rows.ok], rows.reached[rows.ok])


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_every_well_conditioned_joint_aims_as_by_ozz(aim_file, dtype):
    rows = table(aim_file, edges=False)
    rows = rows.pick(rows.well_conditioned)
    assert rows.ok.all() and len(rows.ok) == 2967
    ours, reached = aimed(rows, dtype)
    long_way = rows.long_way_blend[:, None]
    want = np.where(long_way, rows.correction_ref64_shortest, rows.joint_correction)
    error = angles(ours, wxyz(want))
    # What is not reached has no meeting point.
    near = np.zeros(len(rows.ok), bool)
    meeting, target = meeting_points(rows.pick(rows.reached))
    near[rows.reached] = 1 + np.vecdot(meeting, target) < OPPOSED
    assert error[~near].max() < AIM
    # Ozz makes half a turn of these, and misses the target by the rest.
    assert set(rows.category[near]) == {"opposite"}
    assert error[near].max() < AIM + np.sqrt(2 * OPPOSED)
    np.testing.assert_array_equal(reached, rows.reached)


def test_a_nearly_opposed_joint_looks_at_its_target_where_ozz_misses_it(aim_file):
    rows = table(aim_file, edges=False)
    rows = rows.pick(rows.well_conditioned & (rows.category == "opposite") & (rows.weight == 1))
    meeting, target = meeting_points(rows)
    turns = aimed(rows)[0], wxyz(rows.joint_correction)
    ours, theirs = (
        np.linalg.norm(
            np.cross(quat.rotate(jnp.asarray(turn), jnp.asarray(meeting)), target), axis=-1
        )
        for turn in turns
    )
    assert ours.max() < 1e-6
    assert 1e-3 < theirs.max() < np.sqrt(2 * OPPOSED)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_no_aim_is_too_badly_conditioned_for_a_unit_answer(aim_file, dtype):
    rows = table(aim_file, edges=False)
    ours, reached = aimed(rows, dtype)
    eps = np.finfo(dtype).eps
    np.testing.assert_allclose(np.linalg.norm(ours, axis=-1), 1.0, rtol=0, atol=8 * eps)
    np.testing.assert_array_equal(reached, rows.reached)


def test_the_joints_of_ozz_s_unit_tests_aim_as_those_tests_expect(aim_file):
    rows = table(aim_file, edges=True)
    # Ozz refuses a forward axis that is not of unit length; ours is asked for as unit, no more.
    assert rows.name[~rows.expect_ok].tolist() == ["JobValidity/unnormalized_forward"]
    ours, reached = aimed(rows)
    assert np.isfinite(ours).all()
    error = angles(ours, wxyz(rows.expect_correction))
    for i, name in enumerate(rows.name):
        if rows.expect_correction_on[i]:
            assert error[i] < rows.expect_tol[i], name
        if rows.expect_reached[i] >= 0:
            assert reached[i] == rows.expect_reached[i], name
    np.testing.assert_array_equal(reached[rows.ok], rows.reached[rows.ok])
