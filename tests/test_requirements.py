"""Versions of other packages: what the project says it needs is what its checks install."""

import re
import tomllib

import pytest

from support.experiments import ROOT

JAX_FAMILY = ["jax", "equinox", "optimistix", "lineax"]


def required_versions() -> dict[str, str]:
    """By package, what pyproject.toml asks for."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    matches = [re.fullmatch(r"([\w-]+)(.*)", text) for text in project["dependencies"]]
    return {match[1]: match[2] for match in matches if match}


def pinned_versions() -> dict[str, str]:
    """By package, the version on which all tests run."""
    lines = (ROOT / ".ci" / "constraints.txt").read_text(encoding="utf-8").split()
    return dict(line.split("==") for line in lines)


@pytest.mark.parametrize("package", JAX_FAMILY)
def test_the_lowest_version_is_the_one_on_which_all_tests_run_and_there_is_no_highest(package):
    assert required_versions()[package] == f">={pinned_versions()[package]}"
