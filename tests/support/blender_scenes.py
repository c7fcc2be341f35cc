"""Runs in a Python that has Blender as a module: imports and exports motion, notes where bones are.

    python blender_scenes.py walk.bvh walk.glb FOLDER

Writes into the folder what Blender exports of both, and for each file `<file>.npz` with the names
of bones and the positions of their heads, (frames, bones, 3), metres of the scene, y up.
"""

import sys
from pathlib import Path

import bpy  # pyright: ignore[reportMissingImports]
import numpy as np

RATE = 30


def begin() -> None:
    """An empty scene at the rate of the clips."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.context.scene.render.fps = RATE


def armature():
    """The skeleton of the scene, in its pose and not at rest."""
    return next(thing for thing in bpy.data.objects if thing.type == "ARMATURE")


def y_up(points) -> np.ndarray:
    """Positions, m, of Blender's scene, (..., 3), y up."""
    x, y, z = np.moveaxis(np.array(points, np.float64), -1, 0)
    return np.stack([x, z, -y], axis=-1)


def save_heads(path: Path) -> None:
    """Writes where the heads of all bones are in each frame of the scene's animation."""
    scene, skeleton = bpy.context.scene, armature()
    first, last = (round(frame) for frame in skeleton.animation_data.action.frame_range)
    scene.frame_start, scene.frame_end = first, last
    heads = []
    for frame in range(first, last + 1):
        scene.frame_set(frame)
        heads.append([skeleton.matrix_world @ bone.head for bone in skeleton.pose.bones])
    names = np.array([bone.name for bone in skeleton.pose.bones])
    np.savez(path.with_name(path.name + ".npz"), names=names, heads=y_up(heads))


def save_body(path: Path) -> None:
    """Writes where the vertices of the mesh on the skeleton are in the last frame, m, y up."""
    (body,) = [thing for thing in bpy.data.objects if thing.find_armature() == armature()]
    moved = body.evaluated_get(bpy.context.evaluated_depsgraph_get())
    places = [moved.matrix_world @ vertex.co for vertex in moved.to_mesh().vertices]
    np.savez(path, vertices=y_up(places))


def dress(skeleton) -> None:
    """Hangs a skinned mesh with a morph on the skeleton, and both below a turned, scaled node."""
    bpy.ops.mesh.primitive_cube_add(size=0.2)
    mesh = bpy.context.object
    mesh.parent = skeleton
    for bone in skeleton.pose.bones:
        mesh.vertex_groups.new(name=bone.name).add(range(8), 1.0, "REPLACE")
    mesh.modifiers.new("skin", "ARMATURE").object = skeleton
    mesh.shape_key_add(name="rest")
    mesh.shape_key_add(name="smile").data[0].co.x += 0.05
    above = bpy.data.objects.new("above", None)
    bpy.context.collection.objects.link(above)
    above.rotation_euler, above.scale, above.location = (0.3, -0.2, 1.0), (2.0,) * 3, (1, 2, 0.5)
    skeleton.parent = above
    skeleton.rotation_euler, skeleton.scale = (-1.2, 0.4, 0.1), (0.01,) * 3
    bpy.context.view_layer.update()


def main(bvh: Path, glb: Path, folder: Path) -> None:
    """Imports both files, and exports them again, plainly and as a character in a larger scene."""
    begin()
    bpy.ops.import_scene.gltf(filepath=str(glb))
    save_heads(folder / "imported.glb")
    save_body(folder / "body.npz")
    begin()
    bpy.ops.import_anim.bvh(filepath=str(bvh), frame_start=1)
    save_heads(folder / "imported.bvh")
    scene = bpy.context.scene
    exported = str(folder / "exported.bvh")
    bpy.ops.export_anim.bvh(filepath=exported, frame_start=1, frame_end=scene.frame_end)
    save_heads(folder / "exported.bvh")
    for name in ("exported.glb", "dressed.glb", "dressed.gltf"):
        if name == "dressed.glb":
            dress(armature())
        kind = "GLB" if name.endswith("glb") else "GLTF_SEPARATE"
        save_heads(folder / name)
        bpy.ops.export_scene.gltf(filepath=str(folder / name), export_format=kind)
    scene.frame_set(scene.frame_start)
    walk = armature().animation_data.action
    still = walk.copy()
    still.name = "Still"
    for action in (walk, still):
        track = armature().animation_data.nla_tracks.new()
        track.strips.new(action.name, 1, action)
    bpy.ops.export_scene.gltf(filepath=str(folder / "two.glb"), export_format="GLB")


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:4]))
