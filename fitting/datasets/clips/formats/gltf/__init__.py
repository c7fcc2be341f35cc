"""glTF 2.0 and its binary form GLB: skeletons with their animations.

`document` reads the file and its arrays, `tree` finds the joints among the nodes, `sampling` gives
the values of an animation at any time, and `reader` makes a `Recording` of these. `writer` makes
a GLB of a clip.

No library does this part: trimesh, which reads the meshes, ignores animations, and pygltflib gives
the header as classes and leaves arrays, curves and the tree of nodes to its caller.
"""
