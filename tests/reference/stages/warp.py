"""Strides of another length."""

from reference.stages.shifts import warp as moved  # noqa: F401
