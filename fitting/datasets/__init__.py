"""Data that parameters are fitted to: motion clips, terrain, and their synthetic counterparts.

- `clips`: `Clip`, its file formats, recognition of legs, contact labels, edits.
- `terrain`: mesh files, and terrain reconstructed from the stances of a clip.
- `synthetic`: walks, animals and terrain made from parameters.
- `flat_animation`: the animation on flat ground that belongs to a clip captured on uneven ground.
- `clip_frames`: clips to frames of the foot IK pipeline, and its results back to clips.
- `ground_path`: the ground along a clip's path, and a root that follows it.
- `coverage`: how much ground there is under the feet, and what to do where there is little.

Nothing here knows what is fitted or how; that begins in `fitting.problem`.

Start with `clips.load_clip`, then `clip_frames.frames_from_clip`.
"""
