"""Chromium, which draws without a screen and without a graphics card."""

import shutil
from typing import Any

import pytest

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
SOFTWARE_GL = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")

needs_chromium = pytest.mark.skipif(
    CHROMIUM is None, reason="needs chromium, which is not installed"
)


def launch(driver: Any) -> Any:
    """A browser of a playwright driver."""
    return driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", *SOFTWARE_GL])
