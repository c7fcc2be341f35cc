"""Synthetic clips and terrain: motion whose true contacts and geometry are known exactly.

`walker.walk` makes a human walk on a flat floor, from the curves of a measured walk cycle, with the
feet placed exactly (`footsteps`); it may slip, slide and stop. `actions` makes a run, a jump, a
crouch, sitting, an idle and a turn. Both carry a body whose bones keep their lengths. `multi_limb`
makes a quadruped and a climber. `terrain_meshes` makes slopes, steps, rubble and the courses of the
shipped experiments.

Nothing here knows foot IK or its parameters; `data/make.py` combines the two into the shipped data.
Start with `walker.walk`.
"""
