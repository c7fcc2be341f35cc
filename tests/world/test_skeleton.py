"""Transforms and skeletons, compared with SciPy and with forward kinematics by matrices."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from jaxik.world.frame import rise_of
from jaxik.world.skeleton import (
    LegPose,
    Skeleton,
    Still,
    Transform,
    bone_lengths,
    forward_kinematics,
)
from support.clips import assert_close
from support.gradients import (
    ROWS,
    TINY,
    assert_all_gradients_match,
    quaternions,
    unit,
    vectors,
)

RNG = np.random.default_rng(2)
CHAIN, FORK = (-1, 0, 1, 1, 3), (-1, 0, 0)
OFFSETS = RNG.normal(size=(5, 3))


def transforms() -> Transform:
    return Transform(jnp.asarray(vectors(RNG, 1.0, TINY, 0.0)), jnp.asarray(quaternions(RNG)))


def matrices(transform: Transform) -> np.ndarray:
    """4 x 4."""
    result = np.tile(np.eye(4), (*transform.pos.shape[:-1], 1, 1))
    rotations = Rotation.from_quat(np.asarray(transform.rot), scalar_first=True)
    result[..., :3, :3], result[..., :3, 3] = rotations.as_matrix(), transform.pos
    return result


def random_rotations(*shape: int) -> np.ndarray:
    return unit(RNG.normal(size=(*shape, 4)))


def pose(parents: tuple[int, ...], offsets, rotations, positions=None) -> Transform:
    """World transforms of the joints of a skeleton."""
    names = tuple(f"joint{joint}" for joint in range(len(parents)))
    skeleton = Skeleton(jnp.asarray(offsets), names, parents)
    return forward_kinematics(skeleton, jnp.asarray(rotations), positions)


def pose_of_chain(offsets, rotations, positions):
    return pose(CHAIN, offsets, rotations, positions)


def pose_of_fork(offsets, rotations):
    return pose(FORK, offsets, rotations)


def test_transforms_agree_with_matrices_from_scipy():
    a, b, points = transforms(), transforms(), vectors(RNG, 1.0, TINY, 0.0)
    assert_allclose(matrices(a @ b), matrices(a) @ matrices(b), atol=1e-14)
    assert_allclose(matrices(a.inverse()), np.linalg.inv(matrices(a)), atol=1e-14)
    assert_allclose(a.apply_rot(b.rot), (a @ b).rot, atol=0)
    moved = matrices(a) @ np.concatenate([points, np.ones((ROWS, 1))], axis=1)[..., None]
    assert_allclose(a.apply(jnp.asarray(points)), moved[:, :3, 0], atol=1e-14)


def test_transforms_form_a_group():
    a, b, c = transforms(), transforms(), transforms()
    identity = Transform.identity(a.pos.dtype)
    assert_close((a @ b) @ c, a @ (b @ c), 1e-13)
    assert_close(a @ a.inverse(), jax.tree.map(lambda x: jnp.tile(x, (ROWS, 1)), identity), 1e-13)
    assert_close(a @ identity, a, 1e-13)
    assert_close((a @ b).inverse(), b.inverse() @ a.inverse(), 1e-13)


@pytest.mark.parametrize("angles", [[0, 0, 0], [20, -30, 15]], ids=["level", "turning"])
def test_a_place_rises_as_the_platform_that_carries_it(angles):
    before = np.array([[0.3, 0.1, -0.2], [-0.4, 0.2, 0.5]])
    turn, shift = Rotation.from_euler("xyz", angles, degrees=True), np.array([0.2, 0.35, -0.1])
    after, up = turn.apply(before) + shift, jnp.array([0.0, 1.0, 0.0])
    carry = Transform(jnp.asarray(shift), jnp.asarray(turn.as_quat(scalar_first=True)))
    rise = rise_of(carry.repeat(2), jnp.asarray(after), up)
    assert_allclose(rise, (after - before)[:, 1], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(rise_of(Still(), jnp.asarray(before), up), 0.0)


@pytest.mark.parametrize(
    "parents",
    [(-1, 0, 1, 2, 3, 4), (-1, 0, 0, 0, 0, 0), (-1, 0, 1, 0, 3, 1), (-1, -1, 0, 1, -1, 4)],
    ids=["chain", "star", "tree", "forest"],
)
def test_forward_kinematics_multiplies_the_matrices_from_the_root_down(parents):
    offsets, translated = RNG.normal(size=(2, 6, 3))
    offsets[RNG.integers(6)] = 0.0  # a bone of length zero
    rotations = random_rotations(6)
    for positions, argument in ((offsets, None), (translated, jnp.asarray(translated))):
        local = matrices(Transform(jnp.asarray(positions), jnp.asarray(rotations)))
        expected = []
        for joint, parent in enumerate(parents):
            expected.append(local[joint] if parent < 0 else expected[parent] @ local[joint])
        world = pose(parents, offsets, rotations, argument)
        assert_allclose(matrices(world), expected, atol=1e-13)


def test_a_batch_of_poses_equals_single_poses_in_either_precision():
    rotations, positions = random_rotations(2, 3, 5), RNG.normal(size=(2, 3, 5, 3))
    args = [jnp.asarray(x) for x in (OFFSETS, rotations, positions)]
    single = jax.vmap(jax.vmap(pose_of_chain, (None, 0, 0)), (None, 0, 0))
    clip = jax.jit(pose_of_chain)(*args)
    assert clip.pos.shape == (2, 3, 5, 3) and clip.rot.shape == (2, 3, 5, 4)
    assert_close(clip, jax.jit(single)(*args), 1e-14)
    for dtype in (jnp.float32, jnp.float64):
        shapes = jax.eval_shape(pose_of_chain, *(x.astype(dtype) for x in args))
        identity = Transform.identity(dtype)
        assert {leaf.dtype for leaf in jax.tree.leaves((shapes, identity))} == {jnp.dtype(dtype)}


def test_gradients_of_forward_kinematics_match_finite_differences():
    rotations = np.stack([quaternions(RNG) for _ in FORK], axis=1)
    assert_all_gradients_match(pose_of_fork, np.tile(OFFSETS[:3], (ROWS, 1, 1)), rotations)


@pytest.mark.parametrize(
    ("names", "parents", "offsets", "message"),
    [
        ("a", (-1, 0), 2, "1 names, 2 parents, 2 offsets"),
        ("ab", (-1, 0), 3, "2 names, 2 parents, 3 offsets"),
        ("ab", (1, -1), 2, r"joint 0 \(a\) has parent 1"),
        ("ab", (-1, 1), 2, r"joint 1 \(b\) has parent 1"),
        ("ab", (-1, -2), 2, r"joint 1 \(b\) has parent -2"),
    ],
)
def test_a_skeleton_that_is_not_a_tree_is_rejected_with_the_faulty_joint(
    names, parents, offsets, message
):
    with pytest.raises(ValueError, match=message):
        Skeleton(jnp.zeros((offsets, 3)), tuple(names), parents)


def test_a_transformed_pose_keeps_its_bone_lengths():
    # Two hanging legs: thighs of 0.4 and 0.5 m, shins of 0.3 and 0.45 m.
    joints = np.zeros((4, 2, 3))
    joints[..., 1] = [[1.0, 1.1], [0.6, 0.6], [0.3, 0.15], [0.3, 0.15]]
    joints[3, :, 2] = 0.12
    rot = jnp.asarray(np.tile([1.0, 0.0, 0.0, 0.0], (2, 1)))
    legs = LegPose(*(Transform(jnp.asarray(pos), rot) for pos in joints))
    by = jax.tree.map(lambda x: x[:, None], transforms())
    moved = legs.transformed(by)
    thigh, shin = bone_lengths(moved)
    assert_allclose(thigh, np.tile([0.4, 0.5], (ROWS, 1)), atol=1e-14)
    assert_allclose(shin, np.tile([0.3, 0.45], (ROWS, 1)), atol=1e-14)
    back = by.inverse().apply(moved.toe.pos)
    assert_allclose(back, np.tile(joints[3], (ROWS, 1, 1)), atol=1e-14)
    assert_allclose(moved.ankle.rot, np.repeat(by.rot, 2, axis=1), atol=1e-15)


def test_repeating_a_transform_adds_up_the_gradients_of_its_copies():
    transform = Transform(jnp.asarray([1.0, 2.0, 3.0]), jnp.asarray([0.5, 0.5, -0.5, 0.5]))
    copies = transform.repeat(3)
    assert_allclose(copies.pos, np.tile(transform.pos, (3, 1)), atol=0)
    assert_allclose(copies.rot, np.tile(transform.rot, (3, 1)), atol=0)
    weights = jnp.asarray([[1.0], [10.0], [100.0]])
    gradient = jax.grad(lambda transform: jnp.sum(weights * transform.repeat(3).pos))(transform)
    assert_allclose(gradient.pos, [111.0] * 3, atol=0)
