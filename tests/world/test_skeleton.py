"""Transforms and skeletons, compared with SciPy and with forward kinematics by matrices."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from jaxik.world.skeleton import (
    LegPose,
    Rig,
    Skeleton,
    Transform,
    bone_lengths,
    forward_kinematics,
)
from support.gradients import TINY, assert_gradients_match, quaternions, vectors

few = settings(max_examples=15, derandomize=True, deadline=None)
RNG = np.random.default_rng(2)


@st.composite
def transforms(draw: st.DrawFn) -> Transform:
    pos, rot = draw(vectors((1.0, TINY, 0.0))), draw(quaternions())
    return Transform(jnp.asarray(pos), jnp.asarray(rot))


@st.composite
def parents(draw: st.DrawFn) -> tuple[int, ...]:
    """Trees of six joints: chains, stars and anything between, with one root or several."""
    return tuple(draw(st.integers(-1, joint - 1)) for joint in range(6))


def random_rotations(rng: np.random.Generator, *shape: int) -> np.ndarray:
    q = rng.normal(size=(*shape, 4))
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def matrix(pos, rot) -> np.ndarray:
    """The transform as a 4 x 4 matrix."""
    result = np.eye(4)
    result[:3, :3] = Rotation.from_quat(np.asarray(rot), scalar_first=True).as_matrix()
    result[:3, 3] = pos
    return result


def tree(parents: tuple[int, ...], offsets) -> Skeleton:
    names = tuple(f"joint{joint}" for joint in range(len(parents)))
    return Skeleton(jnp.asarray(offsets), names, parents)


def world_matrices(parents, rotations, positions) -> list[np.ndarray]:
    """World matrix of each joint, multiplied along its own chain of parents."""
    matrices = []
    for joint in range(len(parents)):
        world = np.eye(4)
        while joint >= 0:
            world = matrix(positions[joint], rotations[joint]) @ world
            joint = parents[joint]
        matrices.append(world)
    return matrices


@few
@given(transforms(), transforms(), vectors((1.0, TINY, 0.0)))
def test_transforms_agree_with_matrices_from_scipy(a, b, point):
    product = a @ b
    assert_allclose(
        matrix(product.pos, product.rot), matrix(a.pos, a.rot) @ matrix(b.pos, b.rot), atol=1e-14
    )
    assert_allclose(
        a.apply(jnp.asarray(point)), (matrix(a.pos, a.rot) @ [*point, 1])[:3], atol=1e-14
    )
    inverse = a.inverse()
    assert_allclose(
        matrix(inverse.pos, inverse.rot), np.linalg.inv(matrix(a.pos, a.rot)), atol=1e-14
    )
    assert_allclose(a.apply_rot(b.rot), product.rot, atol=0)


@few
@given(transforms(), transforms(), transforms())
def test_transforms_form_a_group(a, b, c):
    for left, right in (
        ((a @ b) @ c, a @ (b @ c)),
        (a @ a.inverse(), Transform.identity(a.pos.dtype)),
        (a @ Transform.identity(a.pos.dtype), a),
        ((a @ b).inverse(), b.inverse() @ a.inverse()),
    ):
        assert_allclose(left.pos, right.pos, atol=1e-13)
        assert_allclose(left.rot, right.rot, atol=1e-13)


@few
@given(parents(), st.integers(0, 2**32 - 1))
def test_forward_kinematics_multiplies_the_matrices_from_the_root_down(parents, seed):
    rng = np.random.default_rng(seed)
    count = len(parents)
    offsets, rotations = rng.normal(size=(count, 3)), random_rotations(rng, count)
    offsets[rng.integers(count)] = 0.0  # a bone of length zero
    skeleton = tree(parents, offsets)
    translated = rng.normal(size=(count, 3))
    for positions, argument in ((offsets, None), (translated, jnp.asarray(translated))):
        world = forward_kinematics(skeleton, jnp.asarray(rotations), argument)
        pos, rot = np.asarray(world.pos), np.asarray(world.rot)
        for joint, expected in enumerate(world_matrices(parents, rotations, positions)):
            assert_allclose(matrix(pos[joint], rot[joint]), expected, atol=1e-13)


CHAIN = (-1, 0, 1, 1, 3)
OFFSETS = RNG.normal(size=(5, 3))


def pose_of_chain(offsets, rotations, positions):
    return forward_kinematics(tree(CHAIN, offsets), rotations, positions)


def pose_of_fork(offsets, rotations):
    return forward_kinematics(tree((-1, 0, 0), offsets), rotations)


def test_without_rotations_the_offsets_add_up():
    rotations = jnp.asarray(np.tile([1.0, 0.0, 0.0, 0.0], (5, 1)))
    world = jax.jit(pose_of_chain)(OFFSETS, rotations, None)
    sums = [OFFSETS[0], OFFSETS[:2].sum(0), OFFSETS[:3].sum(0)]
    assert_allclose(np.asarray(world.pos)[:3], sums, atol=1e-15)
    assert_allclose(np.asarray(world.pos)[4], OFFSETS[[0, 1, 3, 4]].sum(0), atol=1e-15)


def test_rotating_joints_keeps_the_bone_lengths():
    rotations = jnp.asarray(random_rotations(RNG, 20, 5))
    pos = np.asarray(jax.jit(pose_of_chain)(OFFSETS, rotations, None).pos)
    bones = pos[:, 1:] - pos[:, CHAIN[1:]]
    lengths = np.broadcast_to(np.linalg.norm(OFFSETS[1:], axis=-1), (20, 4))
    assert_allclose(np.linalg.norm(bones, axis=-1), lengths, atol=1e-14)


def test_a_batch_of_poses_equals_single_poses_in_either_precision():
    rotations, positions = random_rotations(RNG, 2, 3, 5), RNG.normal(size=(2, 3, 5, 3))
    clip = jax.jit(pose_of_chain)(*map(jnp.asarray, (OFFSETS, rotations, positions)))
    assert clip.pos.shape == (2, 3, 5, 3) and clip.rot.shape == (2, 3, 5, 4)
    single = jax.vmap(jax.vmap(pose_of_chain, (None, 0, 0)), (None, 0, 0))
    frames = jax.jit(single)(*map(jnp.asarray, (OFFSETS, rotations, positions)))
    assert_allclose(clip.pos, frames.pos, atol=1e-14)
    assert_allclose(clip.rot, frames.rot, atol=1e-14)
    for dtype in (jnp.float32, jnp.float64):
        args = (jnp.asarray(x, dtype) for x in (OFFSETS, rotations, positions))
        shapes = jax.eval_shape(pose_of_chain, *args)
        assert shapes.pos.dtype == shapes.rot.dtype == dtype
        identity = Transform.identity(dtype)
        assert identity.pos.dtype == identity.rot.dtype == dtype


@few
@given(st.lists(quaternions(), min_size=3, max_size=3))
def test_gradients_of_forward_kinematics_match_finite_differences(rotations):
    assert_gradients_match(pose_of_fork, OFFSETS[:3], np.array(rotations))


@pytest.mark.parametrize(
    ("names", "parents", "offsets", "message"),
    [
        (("a",), (-1, 0), 2, "1 names, 2 parents, 2 offsets"),
        (("a", "b"), (-1, 0), 3, "2 names, 2 parents, 3 offsets"),
        (("a", "b"), (1, -1), 2, r"joint 0 \(a\) has parent 1"),
        (("a", "b"), (-1, 1), 2, r"joint 1 \(b\) has parent 1"),
        (("a", "b"), (-1, -2), 2, r"joint 1 \(b\) has parent -2"),
    ],
)
def test_a_skeleton_that_is_not_a_tree_is_rejected_with_the_faulty_joint(
    names, parents, offsets, message
):
    with pytest.raises(ValueError, match=message):
        Skeleton(jnp.zeros((offsets, 3)), names, parents)


def leg_pose() -> LegPose:
    """Two hanging legs: thighs of 0.4 and 0.5 m, shins of 0.3 and 0.45 m."""
    rot = jnp.asarray(np.tile([1.0, 0.0, 0.0, 0.0], (2, 1)))
    heights = np.array([[1.0, 1.1], [0.6, 0.6], [0.3, 0.15], [0.3, 0.15]])
    joints = np.zeros((4, 2, 3))
    joints[..., 1] = heights
    joints[3, :, 2] = 0.12
    return LegPose(*(Transform(jnp.asarray(pos), rot) for pos in joints))


@few
@given(transforms())
def test_a_transformed_pose_keeps_its_bone_lengths(by):
    moved = leg_pose().transformed(by)
    thigh, shin = bone_lengths(moved)
    assert_allclose(thigh, [0.4, 0.5], atol=1e-14)
    assert_allclose(shin, [0.3, 0.45], atol=1e-14)
    assert_allclose(by.inverse().apply(moved.toe.pos), leg_pose().toe.pos, atol=1e-14)
    assert_allclose(moved.ankle.rot, np.tile(by.rot, (2, 1)), atol=1e-15)


def test_repeating_a_transform_adds_up_the_gradients_of_its_copies():
    transform = Transform(jnp.asarray([1.0, 2.0, 3.0]), jnp.asarray([0.5, 0.5, -0.5, 0.5]))
    copies = transform.repeat(3)
    assert_allclose(copies.pos, np.tile(transform.pos, (3, 1)), atol=0)
    assert_allclose(copies.rot, np.tile(transform.rot, (3, 1)), atol=0)
    weights = jnp.asarray([[1.0], [10.0], [100.0]])
    gradient = jax.grad(lambda transform: jnp.sum(weights * transform.repeat(3).pos))(transform)
    assert_allclose(gradient.pos, [111.0] * 3, atol=0)


def test_names_and_joints_of_a_rig_are_static():
    rig = Rig(
        knee_axis_ls=jnp.asarray([[1.0, 0.0, 0.0]] * 2),
        ankle_from_foot=jnp.asarray(np.tile([1.0, 0.0, 0.0, 0.0], (2, 1))),
        thigh=jnp.full(2, 0.4),
        shin=jnp.full(2, 0.4),
        foot=jnp.full(2, 0.15),
        ankle_height=jnp.full(2, 0.08),
        ball_height=jnp.full(2, 0.05),
        side=jnp.asarray([1.0, -1.0]),
        present=jnp.asarray([True, True]),
        names=("left", "right"),
        joints=((1, 2, 3, 4), (5, 6, 7, 8)),
        pelvis=0,
    )
    leaves, structure = jax.tree.flatten(rig)
    assert len(leaves) == 9
    assert jax.tree.unflatten(structure, leaves).names == ("left", "right")
    batch = jax.vmap(lambda thigh: jax.tree.map(lambda x: x, rig).thigh * thigh)(jnp.arange(3.0))
    assert batch.shape == (3, 2)
