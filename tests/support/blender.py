"""Python with Blender as a module, which has an environment of its own."""

import os
import subprocess

import pytest


def python() -> str:
    """The path that BLENDER_PYTHON names; the test is skipped where there is none."""
    path = os.environ.get("BLENDER_PYTHON")
    if path is None:
        pytest.skip("BLENDER_PYTHON names no Python with Blender as a module (bpy)")
    ready = subprocess.run([path, "-c", "import bpy"], capture_output=True, text=True)
    if ready.returncode:
        pytest.skip(f"{path} cannot import bpy: {ready.stderr.strip()[-200:]}")
    return path
