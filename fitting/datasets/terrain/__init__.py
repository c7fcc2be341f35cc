"""Terrain: meshes, heightfields, their files, and the reconstruction of terrain from a clip.

`mesh_files` reads what trimesh reads, and heightfields (`heightfield_files`: NPZ, NPY, PNG); it
writes PLY, OBJ and STL. `reconstruction` estimates the ground below a clip from where its feet
stood: it fits the `surfaces` (a plane, a thin plate, level blocks on a grid found by `block_grids`)
and chooses by cross-validation.

Rays and contact are not computed here but in `jaxik.world.terrain`.

Start with `mesh_files.load_terrain`, or with `reconstruction.reconstruct`.
"""
