"""The shapes of characters on pages: persons, legs alone, and four limbs."""

from dataclasses import replace

import numpy as np
import pytest

from fitting.clips import Clip
from fitting.clips.assemble import JointMotion, clip_from_joints
from fitting.report import bodies
from fitting.synthetic import multi_limb, walker
from support.clips import legs_alone


@pytest.fixture(scope="module")
def person() -> Clip:
    return walker.walk(1.2, 30.0)


def places(clip: Clip, packed: dict) -> list[np.ndarray]:
    """All points of a shape in all frames; those of the soles are not needed."""
    points = list(np.moveaxis(clip.positions_ws, 1, 0))
    points += 2 * len(clip.rig.names) * [np.full((clip.frame_count, 3), np.nan)]
    for a, b, share in packed["between"]:
        points.append(points[a] + share * (points[b] - points[a]))
    return points


def height(clip: Clip) -> float:
    """Of the top of a character, m over its lowest joint."""
    packed = bodies.pack(clip)
    points = places(clip, packed)
    tops = [points[limb[1]][0, 1] + limb[4] for limb in packed["limbs"]]
    return max(tops) - clip.positions_ws[0, :, 1].min()


@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_a_person_is_as_tall_as_one_and_grows_with_the_legs(person, scale):
    motion = JointMotion(
        person.joint_names, person.parents, scale * person.positions_ws, person.rotations_ws,
        person.stance_labels(), person.fps,
    )  # fmt: skip
    small = clip_from_joints(motion, "small")
    assert 1.65 * scale < height(small) < 1.85 * scale


def test_a_person_has_arms_wider_hips_than_waist_and_a_head_on_top(person):
    packed = bodies.pack(person)
    ends = {tuple(limb[:2]) for limb in packed["limbs"]}
    names = person.joint_names
    for side in ("left", "right"):
        arm = [names.index(f"{side}_{part}") for part in ("shoulder", "elbow", "wrist")]
        assert set(zip(arm, arm[1:], strict=False)) <= ends
        assert any(start == arm[-1] for start, _ in ends), "a hand"
    flat = [limb for limb in packed["limbs"] if limb[5] == bodies.DEPTH]
    (hips, _, waist), (again, chest, _) = (limb[2:5] for limb in flat)
    assert hips > waist == again < chest
    points = places(person, packed)
    highest = max(packed["limbs"], key=lambda limb: points[limb[1]][0, 1] + limb[4])
    assert highest[5] == bodies.HEAD_DEPTH


def test_legs_alone_have_hips_and_nothing_above_the_pelvis(person):
    legs = legs_alone(person)
    assert height(legs) < 1.15
    assert len(bodies.pack(legs)["limbs"]) == 4 + 2  # hips and what joins them to the pelvis


@pytest.mark.parametrize(
    ("make", "girdles"), [(multi_limb.locomotion, multi_limb.QUADRUPED), (multi_limb.climb, None)]
)
def test_four_limbs_have_one_trunk_between_them(make, girdles):
    clip = make(girdles, 1.0) if girdles else make(1.0)
    packed = bodies.pack(clip)
    trunks = [limb for limb in packed["limbs"] if limb[5] == bodies.BARREL_DEPTH]
    assert len(trunks) == 1 and len(packed["feet"]) == 4


def test_every_joint_is_in_a_limb_or_near_one(person):
    finger = person.positions_ws[:, -1:] + [0.0, -0.3, 0.05]
    motion = JointMotion(
        (*person.joint_names, "tail"), (*person.parents, 0),
        np.concatenate([person.positions_ws, finger], axis=1),
        np.concatenate([person.rotations_ws, person.rotations_ws[:, :1]], axis=1),
        person.stance_labels(), person.fps,
    )  # fmt: skip
    tailed = clip_from_joints(motion, "tailed")
    ends = {joint for limb in bodies.pack(tailed)["limbs"] for joint in limb[:2]}
    hidden = {"neck", "chest", "spine", "head", "left_toe", "right_toe"}  # inside what is drawn
    missing = {name for joint, name in enumerate(tailed.joint_names) if joint not in ends}
    assert missing <= hidden and "tail" not in missing


def test_a_foot_that_is_a_point_has_no_sole(person):
    point = person.positions_ws.copy()
    for _, _, ankle, toe in person.rig.joints:
        point[:, toe] = point[:, ankle]
    shape = bodies.pack(replace(person, positions_ws=point))
    assert shape["feet"] == [[], []]
    assert all(len(plan) == 4 for plan in bodies.pack(person)["feet"])
