"""Swings over uneven ground."""

from reference.stages.stride_probe import bump as bump
