"""Transforms and trees of joints: held against SciPy and a forward kinematics of matrices."""

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
    still,
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
    """The transform as a matrix (4 4)."""
    answer = np.eye(4)
    answer[:3, :3] = Rotation.from_quat(np.asarray(rot), scalar_first=True).as_matrix()
    answer[:3, 3] = pos
    return answer


def tree(parents: tuple[int, ...], offsets) -> Skeleton:
    names = tuple(f"joint{joint}" for joint in range(len(parents)))
    return Skeleton(jnp.asarray(offsets), names, parents)


def world_matrices(parents, rotations, positions) -> list[np.ndarray]:
    """Every joint's matrix from the root down, each walked up its own chain of parents."""
    answer = []
    for joint in range(len(parents)):
        world = np.eye(4)
        while joint >= 0:
            world = matrix(positions[joint], rotations[joint]) @ world
            joint = parents[joint]
        answer.append(world)
    return answer


@few
@given(transforms(), transforms(), vectors((1.0, TINY, 0.0)))
def test_transforms_are_the_matrices_of_scipy(a, b, point):
    ours = a @ b
    assert_allclose(
        matrix(ours.pos, ours.rot), matrix(a.pos, a.rot) @ matrix(b.pos, b.rot), atol=1e-14
    )
    assert_allclose(
        a.apply(jnp.asarray(point)), (matrix(a.pos, a.rot) @ [*point, 1])[:3], atol=1e-14
    )
    inverse = a.inverse()
    assert_allclose(
        matrix(inverse.pos, inverse.rot), np.linalg.inv(matrix(a.pos, a.rot)), atol=1e-14
    )
    assert_allclose(a.apply_rot(b.rot), ours.rot, atol=0)


@few
@given(transforms(), transforms(), transforms())
def test_transforms_form_a_group(a, b, c):
    for one, other in (
        ((a @ b) @ c, a @ (b @ c)),
        (a @ a.inverse(), still(a.pos.dtype)),
        (a @ still(a.pos.dtype), a),
        ((a @ b).inverse(), b.inverse() @ a.inverse()),
    ):
        assert_allclose(one.pos, other.pos, atol=1e-13)
        assert_allclose(one.rot, other.rot, atol=1e-13)


@few
@given(parents(), st.integers(0, 2**32 - 1))
def test_forward_kinematics_is_the_product_of_the_matrices_from_the_root(parents, seed):
    rng = np.random.default_rng(seed)
    count = len(parents)
    offsets, rotations = rng.normal(size=(count, 3)), random_rotations(rng, count)
    offsets[rng.integers(count)] = 0.0  # a bone without length
    skeleton = tree(parents, offsets)
    moved = rng.normal(size=(count, 3))
    for positions, given_positions in ((offsets, None), (moved, jnp.asarray(moved))):
        world = forward_kinematics(skeleton, jnp.asarray(rotations), given_positions)
        pos, rot = np.asarray(world.pos), np.asarray(world.rot)
        expected = world_matrices(parents, rotations, positions)
        for joint, wanted in enumerate(expected):
            assert_allclose(matrix(pos[joint], rot[joint]), wanted, atol=1e-13)


CHAIN = (-1, 0, 1, 1, 3)
OFFSETS = RNG.normal(size=(5, 3))


def pose_of_chain(offsets, rotations, positions):
    return forward_kinematics(tree(CHAIN, offsets), rotations, positions)


def pose_of_fork(offsets, rotations):
    return forward_kinematics(tree((-1, 0, 0), offsets), rotations)


def test_without_any_turn_the_offsets_add_up():
    rotations = jnp.asarray(np.tile([1.0, 0.0, 0.0, 0.0], (5, 1)))
    world = jax.jit(pose_of_chain)(OFFSETS, rotations, None)
    sums = [OFFSETS[0], OFFSETS[:2].sum(0), OFFSETS[:3].sum(0)]
    assert_allclose(np.asarray(world.pos)[:3], sums, atol=1e-15)
    assert_allclose(np.asarray(world.pos)[4], OFFSETS[[0, 1, 3, 4]].sum(0), atol=1e-15)


def test_turning_joints_keeps_the_lengths_of_the_bones():
    rotations = jnp.asarray(random_rotations(RNG, 20, 5))
    pos = np.asarray(jax.jit(pose_of_chain)(OFFSETS, rotations, None).pos)
    bones = pos[:, 1:] - pos[:, CHAIN[1:]]
    lengths = np.broadcast_to(np.linalg.norm(OFFSETS[1:], axis=-1), (20, 4))
    assert_allclose(np.linalg.norm(bones, axis=-1), lengths, atol=1e-14)


def test_a_clip_of_poses_is_many_poses_in_either_precision():
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
        assert still(dtype).pos.dtype == still(dtype).rot.dtype == dtype


@few
@given(st.lists(quaternions(), min_size=3, max_size=3))
def test_slopes_of_forward_kinematics_are_those_of_differences(rotations):
    assert_gradients_match(pose_of_fork, OFFSETS[:3], np.array(rotations))


@pytest.mark.parametrize(
    ("names", "parents", "offsets", "words"),
    [
        (("a",), (-1, 0), 2, "1 names, 2 parents, 2 offsets"),
        (("a", "b"), (-1, 0), 3, "2 names, 2 parents, 3 offsets"),
        (("a", "b"), (1, -1), 2, r"joint 0 \(a\) has parent 1"),
        (("a", "b"), (-1, 1), 2, r"joint 1 \(b\) has parent 1"),
        (("a", "b"), (-1, -2), 2, r"joint 1 \(b\) has parent -2"),
    ],
)
def test_a_skeleton_that_is_no_tree_is_refused_with_the_joint_at_fault(
    names, parents, offsets, words
):
    with pytest.raises(ValueError, match=words):
        Skeleton(jnp.zeros((offsets, 3)), names, parents)


def leg_pose() -> LegPose:
    """Two legs that hang: thighs of 0.4 and 0.5 m, shins of 0.3 and 0.45 m."""
    turned = jnp.asarray(np.tile([1.0, 0.0, 0.0, 0.0], (2, 1)))
    heights = np.array([[1.0, 1.1], [0.6, 0.6], [0.3, 0.15], [0.3, 0.15]])
    joints = np.zeros((4, 2, 3))
    joints[..., 1] = heights
    joints[3, :, 2] = 0.12
    return LegPose(*(Transform(jnp.asarray(pos), turned) for pos in joints))


@few
@given(transforms())
def test_a_pose_carried_along_keeps_its_bones(by):
    moved = leg_pose().transformed(by)
    thigh, shin = bone_lengths(moved)
    assert_allclose(thigh, [0.4, 0.5], atol=1e-14)
    assert_allclose(shin, [0.3, 0.45], atol=1e-14)
    assert_allclose(by.inverse().apply(moved.toe.pos), leg_pose().toe.pos, atol=1e-14)
    assert_allclose(moved.ankle.rot, np.tile(by.rot, (2, 1)), atol=1e-15)


def test_copies_of_a_transform_are_it_and_add_up_their_slopes():
    one = Transform(jnp.asarray([1.0, 2.0, 3.0]), jnp.asarray([0.5, 0.5, -0.5, 0.5]))
    several = one.repeat(3)
    assert_allclose(several.pos, np.tile(one.pos, (3, 1)), atol=0)
    assert_allclose(several.rot, np.tile(one.rot, (3, 1)), atol=0)
    weights = jnp.asarray([[1.0], [10.0], [100.0]])
    slope = jax.grad(lambda one: jnp.sum(weights * one.repeat(3).pos))(one)
    assert_allclose(slope.pos, [111.0] * 3, atol=0)


def test_a_rig_is_data_but_for_its_names_and_joints():
    rig = Rig(
        knee_axis_ls=jnp.asarray([[1.0, 0.0, 0.0]] * 2),
        ankle_from_foot=jnp.asarray(np.tile([1.0, 0.0, 0.0, 0.0], (2, 1))),
        thigh=jnp.full(2, 0.4),
        shin=jnp.full(2, 0.4),
        foot=jnp.full(2, 0.15),
        side=jnp.asarray([1.0, -1.0]),
        present=jnp.asarray([True, True]),
        names=("left", "right"),
        joints=((1, 2, 3, 4), (5, 6, 7, 8)),
        pelvis=0,
    )
    leaves, structure = jax.tree.flatten(rig)
    assert len(leaves) == 7
    assert jax.tree.unflatten(structure, leaves).names == ("left", "right")
    batch = jax.vmap(lambda thigh: jax.tree.map(lambda x: x, rig).thigh * thigh)(jnp.arange(3.0))
    assert batch.shape == (3, 2)
