"""glTF files made by hand: trees, curves, choices, and what is refused.

Files that Blender wrote are in `test_clip_writers`.
"""

import json
import struct

import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, Slerp

from fitting.clips import load_clip
from fitting.clips.formats.gltf import read_gltf
from support.gltf_files import Gltf, walker

RAMP = np.array([0.0, 0.1, 0.2, 0.3, 0.4])
PATH = np.array([[0.0, 0, 0], [1, 0, 0], [1, 2, 0], [1, 2, 3], [0, 0, 0]])
ANGLES = [[0, 0, 0], [90, 0, 0], [0, 80, 0], [10, 20, 170], [0, 0, 0]]
TURNS = Rotation.from_euler("xyz", ANGLES, degrees=True)
QUATS = TURNS.as_quat()
TENTH = [0.0, 0.1]  # s
TURNING = TENTH, QUATS[:2], "LINEAR"  # keys of a rotation


@pytest.fixture
def load(tmp_path):
    def load(file: Gltf, **options):
        (tmp_path / "walk.gltf").write_text(file.text())
        return read_gltf(tmp_path / "walk.gltf", **options)

    return load


def turns_of(recording, joint: int) -> Rotation:
    return Rotation.from_quat(recording.rotations_ls[:, joint], scalar_first=True)


def chain(*names: str) -> list[dict]:
    """Nodes, each of which is the child of the one before, 1 m along x."""
    return [
        {"name": name, "translation": [1.0, 0, 0]}
        | ({"children": [index + 1]} if index + 1 < len(names) else {})
        for index, name in enumerate(names)
    ]


def test_a_character_below_a_turned_and_scaled_armature_is_read_in_metres(tmp_path):
    (tmp_path / "walk.gltf").write_text(walker().text())
    clip = load_clip(tmp_path / "walk.gltf")
    assert (clip.fps, clip.frame_count, clip.scale, clip.up_axis) == (30.0, 12, 1.0, "y")
    assert clip.joint_names[0] == "mixamorig:Hips" and len(clip.joint_names) == 9
    # The armature's rotation takes x to y, y to z and z to x.
    hips = clip.positions_ws[:, 0]
    np.testing.assert_allclose(hips[:, 0], 0.95, atol=1e-6)
    np.testing.assert_allclose(hips[:, 2], np.arange(12) / 30, atol=1e-6)
    toe = clip.joint_names.index("mixamorig:RightToeBase")
    np.testing.assert_allclose(clip.positions_ws[0, toe], [0.03, -0.1, 0.12], atol=1e-6)
    np.testing.assert_allclose(clip.offsets_ls[1], [0.1, 0.0, 0.0], atol=1e-6)


def test_a_character_in_centimetres_is_doubted_unless_its_scale_is_given(tmp_path):
    file = walker()
    file.header["nodes"][0]["scale"] = [1.0, 1.0, 1.0]
    (tmp_path / "walk.gltf").write_text(file.text())
    clip = load_clip(tmp_path / "walk.gltf")
    (doubt,) = (remark for remark in clip.remarks if "doubtful" in remark)
    assert "the legs are 87.09 m long" in doubt and "better: 0.01, for centimetres" in doubt
    clip = load_clip(tmp_path / "walk.gltf", scale=0.01)
    assert clip.rig.thigh[0] == pytest.approx(0.45, abs=0.01)
    assert not any("doubtful" in remark for remark in clip.remarks)


@pytest.mark.parametrize("fps", [None, 25.0])
def test_values_between_keys_follow_the_interpolation(load, fps):
    slopes = np.arange(30.0).reshape(2, 5, 3)
    spline = np.stack([slopes[0], PATH, slopes[1]], axis=1).reshape(-1, 3)
    file = Gltf([{"name": "hub", "children": [1, 2, 3, 4]}, {}, {}, {}, {}])
    file.animate("walk", {
        (1, "translation"): (RAMP, PATH, "LINEAR"),
        (2, "translation"): (RAMP, PATH, "STEP"),
        (3, "translation"): (RAMP, spline, "CUBICSPLINE"),
        (4, "rotation"): (RAMP, QUATS, "LINEAR"),
        (0, "rotation"): ([0.0, 0.4], np.tile([0.0, 0, 0, 1], (2, 1)), "LINEAR"),
    })  # fmt: skip
    recording = load(file, fps=fps)
    times = np.arange(11) / 25 if fps else RAMP
    assert recording.frame_time == pytest.approx(times[1])
    straight = np.stack([np.interp(times, RAMP, axis) for axis in PATH.T], axis=-1)
    np.testing.assert_allclose(recording.positions_ls[:, 1], straight, atol=1e-6)
    steps = PATH[np.floor(times * 10 + 1e-6).astype(int)]
    np.testing.assert_allclose(recording.positions_ls[:, 2], steps, atol=1e-6)
    curved = np.empty((len(times), 3))
    for segment in range(4):  # SciPy knows one slope a key, a file two
        ends = slice(segment, segment + 2)
        bounds = np.stack([slopes[1, segment], slopes[0, segment + 1]])
        inside = (times >= RAMP[segment] - 1e-9) & (times <= RAMP[segment + 1] + 1e-9)
        hermite = CubicHermiteSpline(RAMP[ends], PATH[ends], bounds)
        curved[inside] = hermite(times[inside])
    np.testing.assert_allclose(recording.positions_ls[:, 3], curved, atol=1e-5)
    expected = Slerp(RAMP, TURNS)(np.minimum(times, 0.4))
    assert (turns_of(recording, 4) * expected.inv()).magnitude().max() < 1e-6


def test_the_rate_is_that_on_which_most_keys_lie_and_frames_are_not_endless(load):
    times = (np.arange(100) / 23.976).astype(np.float32)
    kept = np.unique(np.append(np.random.default_rng(0).permutation(100)[:40], [0, 98, 99]))
    guess = ("its keys follow no frame rate; sampled at 30 Hz",)
    for keys, frame_time, count, remarks in (
        (times, 1 / 23.976, 100, ()),
        (times[kept], 1 / 23.976, 100, ()),
        ([0.0, 0.0371, 0.13, 2.0], 1 / 30, 61, guess),
        ([1.0], None, 1, ()),
    ):
        still = {(0, "translation"): (keys, np.zeros((len(keys), 3)), "LINEAR")}
        recording = load(Gltf(chain("a", "b")).animate("w", still))
        assert recording.positions_ls.shape == (count, 2, 3) and recording.remarks == remarks
        assert frame_time is None or recording.frame_time == pytest.approx(frame_time, rel=1e-5)
    keys = {(0, "translation"): ([0.0, 1e5], [[0, 0, 0], [1, 0, 0]], "LINEAR")}
    file = Gltf(chain("a", "b")).animate("w", keys)
    with pytest.raises(ValueError, match="1e.05 s at 30 frames per second; wanted at most 500000"):
        load(file)
    assert len(load(file, fps=1.0).positions_ls) == 100_001


def test_all_that_is_above_the_skeleton_moves_it(load):
    nodes = chain("world", "armature", "hips", "knee")
    nodes[1]["scale"] = [1.0, 2.0, 1.0]
    turns = Rotation.from_euler("z", [[0.0], [90.0]], degrees=True).as_quat()
    file = Gltf(nodes, skins=[{"joints": [2, 3]}]).animate("walk", {
        (0, "rotation"): (TENTH, turns, "LINEAR"),
        (2, "rotation"): (TENTH, turns, "LINEAR"),
        (3, "scale"): (TENTH, np.full((2, 3), 7.0), "LINEAR"),
    })  # fmt: skip
    recording = load(file)
    assert recording.names == ("hips", "knee") and recording.parents == (-1, 0)
    np.testing.assert_allclose(recording.positions_ls[:, 0], [[3, 0, 0], [1, 2, 0]], atol=1e-6)
    # Stretched along the hips' y by the armature: 1 m along x, then 2 m along what was y.
    reach = np.linalg.norm(recording.positions_ls[:, 1], axis=-1)
    np.testing.assert_allclose(reach, [1.0, 2.0], atol=1e-6)
    np.testing.assert_allclose(recording.offsets_ls, [[3, 0, 0], [1, 0, 0]], atol=1e-6)


def test_bones_may_be_scaled_to_any_size_and_to_nothing_keep_the_rotation_of_parents(load):
    turning = {(0, "rotation"): (TENTH, QUATS[1:3], "LINEAR")}
    vanishing = {(1, "scale"): (TENTH, np.zeros((2, 3)), "STEP")}
    recording = load(Gltf(chain("a", "b", "c")).animate("w", turning | vanishing))
    np.testing.assert_allclose(recording.positions_ls[:, 2], 0.0, atol=1e-9)
    np.testing.assert_allclose(np.abs(recording.rotations_ls[:, 1:, 0]), 1.0, atol=1e-6)
    for size in (1e-200, 1e20):
        nodes = [node | {"scale": [size] * 3} for node in chain("a", "b", "c")]
        recording = load(Gltf(nodes).animate("w", turning))
        assert (turns_of(recording, 0) * TURNS[1:3].inv()).magnitude().max() < 1e-6


def test_a_matrix_is_a_transform_too_but_is_not_animated(load):
    turn = np.eye(4)
    turn[:3, :3], turn[:3, 3] = Rotation.from_euler("y", 90, degrees=True).as_matrix(), [0, 5, 0]
    root = {"name": "a", "children": [1], "matrix": turn.T.ravel().tolist()}
    nodes, skins = [root, chain("b")[0]], [{"joints": [0, 1]}]
    keys = {(1, "rotation"): TURNING}
    recording = load(Gltf(nodes, skins=skins).animate("w", keys))
    np.testing.assert_allclose(recording.positions_ls[0], [[0, 5, 0], [1, 0, 0]], atol=1e-6)
    with pytest.raises(ValueError, match="walk.gltf: node 0 has a matrix and is animated"):
        load(Gltf(nodes, skins=skins).animate("w", keys | {(0, "rotation"): TURNING}))


def test_joints_are_those_of_the_larger_skin_or_else_what_moves_and_hangs_from_it(load):
    nodes = [{"name": "scene", "children": [1, 5]}, {"name": "hips", "children": [2, 3]}]
    nodes += [{"name": "leg", "children": [4]}, {"name": "shirt", "mesh": 0}, {"name": "foot"}]
    nodes += [{"name": "tree"}]
    keys = {(1, "rotation"): TURNING}
    assert load(Gltf(nodes).animate("w", keys)).names == ("hips", "leg", "foot")
    nodes = chain("hips", "leg", "leg") + [{"name": "prop"}, {}]
    file = Gltf(nodes, skins=[{"joints": [0, 1, 2]}, {"joints": [3]}, {"joints": [4]}])
    recording = load(file.animate("w", {(node, "rotation"): TURNING for node in (0, 3)}))
    assert recording.names == ("hips", "leg", "leg_2")  # equal names are told apart
    assert recording.remarks == ("1 joints of other skeletons in the file are left out",)


def test_joints_that_move_beside_a_skin_and_those_that_hang_from_it_are_taken(load):
    """A skin of the trunk alone; legs whose parts are meshes, and toes that do not move."""
    nodes = [{"name": "hips", "children": [1, 2]}, {"name": "spine"}]
    nodes += [{"name": "leg", "mesh": 0, "children": [3, 4]}, {"name": "toe"}]
    nodes += [{"name": "shoe", "mesh": 0}]
    for skins, skinned in (([{"joints": [1]}], (1,)), ([], ())):
        for moved in ((0, 1, 2), (1, 2), (2,)):
            keys = {(node, "rotation"): TURNING for node in moved}
            recording = load(Gltf(nodes, skins=skins).animate("w", keys))
            assert set(recording.names) >= {"leg", "toe"} and "shoe" not in recording.names
            assert ("spine" in recording.names) == bool(skinned or 1 in moved)
            remarks = ("1 joints that no skin has are taken too, as they move",)
            assert recording.remarks == (remarks if skinned else ())


def test_one_of_several_animations_is_chosen_by_its_name(tmp_path):
    file = walker()
    file.animate("Run", {(1, "translation"): (TENTH, [[0, 0, 90], [0, 0, 80]], "LINEAR")})
    weights = [{"target": {"node": 1, "path": "weights"}}]
    file.header["animations"].append({"name": "Smile", "samplers": [], "channels": weights})
    path = tmp_path / "walk.gltf"
    path.write_text(file.text())
    with pytest.raises(ValueError, match="walk.gltf: 2 animations: 'Walk', 'Run'; choose one with"):
        load_clip(path)
    with pytest.raises(ValueError, match="no animation 'Smile'; there are 'Walk', 'Run'"):
        load_clip(path, animation="Smile")
    assert load_clip(path, animation="Run").frame_count == 2
    assert load_clip(path, animation="Run", fps=60.0).frame_count == 7
    for other in ("a.bvh", "a.npz"):
        (tmp_path / other).touch()
        with pytest.raises(ValueError, match=f"{other}: .*animation"):
            load_clip(tmp_path / other, animation="Run")


def test_numbers_may_be_integers_lie_between_each_other_and_in_a_file_beside(tmp_path):
    file, path = Gltf(chain("a", "b")), tmp_path / "walk.gltf"
    output = file.add(np.round(QUATS[:2] * 32767), "i2", normalized=True)
    path.write_text(file.animate("w", {(0, "rotation"): (TENTH, output, "LINEAR")}).text())
    assert (turns_of(read_gltf(path), 0) * TURNS[:2].inv()).magnitude().max() < 1e-4
    file = Gltf(chain("a", "b"))
    pairs = b"".join(struct.pack("<f3f", t, *point) for t, point in zip(RAMP, PATH, strict=True))
    view = {"buffer": 0, "byteOffset": 4, "byteLength": len(pairs), "byteStride": 16}
    floats = {"bufferView": 0, "componentType": 5126, "count": 5}
    times, points = floats | {"type": "SCALAR"}, floats | {"type": "VEC3", "byteOffset": 4}
    channel = {"sampler": 0, "target": {"node": 1, "path": "translation"}}
    animation = {"samplers": [{"input": 0, "output": 1}], "channels": [channel]}
    file.content = b"\0" * 4 + pairs
    file.header |= {"bufferViews": [view], "accessors": [times, points], "animations": [animation]}
    header = json.loads(file.text())
    header["buffers"][0]["uri"] = "two%20words.bin"
    (tmp_path / "two words.bin").write_bytes(file.content)
    path.write_text(json.dumps(header))
    recording = read_gltf(path)
    assert recording.names == ("b",)
    np.testing.assert_allclose(recording.positions_ls[:, 0], PATH + [1.0, 0, 0], atol=1e-6)
    for uri in ("../two%20words.bin", "/etc/passwd", "https://example.org/x.bin", "no.bin", ""):
        header["buffers"][0]["uri"] = uri
        path.write_text(json.dumps(header))
        with pytest.raises(ValueError, match="walk.gltf: .* is in .* file beside this one"):
            read_gltf(path)


def not_a_number() -> str:
    """The buffer of the walker with a NaN on the way of its hips, in the third key."""
    file = walker()
    view = file.header["bufferViews"][0]
    place = view["byteOffset"] + 4 * (3 * 2 + 1)
    file.content = file.content[:place] + struct.pack("<f", np.nan) + file.content[place + 4 :]
    return json.loads(file.text())["buffers"][0]["uri"]


def test_what_is_no_motion_is_refused_in_one_sentence(tmp_path):
    for path, value, message in (
        ("accessors.0.sparse", {}, "accessor 0 is sparse, which is not supported"),
        ("accessors.0.count", 10**9, "accessor 0 has 1000000000 values of 12 bytes in 144 bytes"),
        ("accessors.0.type", "VEC9", "accessor 0 holds 'VEC9'"),
        ("accessors.1.type", "VEC4", "accessor 1 has 12 values of 16 bytes in 48 bytes"),
        ("bufferViews.0.byteLength", 10**6, "bufferView 0 ends at byte 1000000 of a buffer"),
        ("bufferViews.0.extensions", {"EXT_meshopt_compression": {}}, "is compressed"),
        ("buffers.0.uri", "data:;base64,%%%", "the uri of buffer 0 is not base64"),
        ("buffers.0", {}, "buffer 0 has neither a uri nor a binary part"),
        ("nodes.9.children", [1], "node 1 has two parents"),
        ("nodes.9.children", [0], "nodes that are their own ancestors"),
        ("nodes.9.children", [99], "99 among the children of node 9; wanted a whole number below"),
        ("nodes.2.scale", [1, 2], r"the scale of node 2 is \[1, 2\]; wanted 3 finite numbers"),
        ("nodes.2.rotation", [0, 0, 0, 0], "the rotation of node 2 is not a unit quaternion"),
        ("nodes.2.scale", [1e25] * 3, "LeftLeg is at"),
        ("skins.0.joints", [77], "77 among the joints of a skin"),
        (
            "buffers.0.uri",
            not_a_number(),
            r"translation of mixamorig:Hips, node 1: value 2 of "
            r"accessor 0 is \[0.0, nan, 95.0\]",
        ),
        ("animations", [], "no animation that moves nodes"),
        ("animations.0.samplers.0.interpolation", "SMOOTH", "node 1: interpolation 'SMOOTH'"),
        ("animations.0.samplers.0.input", 2, "node 1: times have 4 numbers for each key"),
        ("animations.0.samplers.0.output", 2, "a translation has 12 x 4 numbers for 12 keys"),
        ("nodes", {}, r"nodes is '\{\}'; wanted a list"),
    ):
        header = item = json.loads(walker().text())
        *place, last = (int(word) if word.isdecimal() else word for word in path.split("."))
        for key in place:
            item = item[key]
        item[last] = value
        (tmp_path / "walk.gltf").write_text(json.dumps(header))
        with pytest.raises(ValueError, match=f"walk.gltf: .*({message})") as error:
            load_clip(tmp_path / "walk.gltf")
        assert "\n" not in str(error.value)
    for content in (b"", b"glTF", b"{", b"[]", b"glTF\2\0\0\0\xff\xff\xff\xff"):
        for name in ("walk.glb", "walk.gltf"):
            (tmp_path / name).write_bytes(content)
            with pytest.raises(ValueError, match=f"{name}: "):
                load_clip(tmp_path / name)
