"""Strides of another length."""

from reference.stages.steps import warp as moved  # noqa: F401
