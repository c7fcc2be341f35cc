"""The ground: terrain files, its reconstruction from a clip, and how a clip lies on it.

`meshes` reads what trimesh reads, and heightfields (NPZ, NPY, PNG); it writes PLY, OBJ and STL.
`reconstruction` estimates the ground below a clip from where its feet stood: it fits a plane, a
thin plate, and level blocks on a grid, and chooses by cross-validation. `ground_path` is the ground
along the way of a body, and the patch of it that a picture shows; `coverage` says how much of a
clip's ground there is.

Rays and contact are not computed here but in `jaxik.world.terrain`. Start with
`meshes.load_terrain`, or with `reconstruction.reconstruct`.
"""
