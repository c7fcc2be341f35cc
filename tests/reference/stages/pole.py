"""Solves legs towards a pole."""

from reference.stages.limb import joint_rotations as joint_rotations
