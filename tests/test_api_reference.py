"""The API reference is made from the docstrings by one command, without warnings."""

import os
import subprocess
import sys

import pytest

import house


@pytest.mark.slow
def test_the_reference_has_a_page_for_every_module(tmp_path):
    command = [sys.executable, "-W", "error", "-m", "pdoc", "--docformat", "google"]
    # pdoc warns of a value that is also in the environment, where the tests put the flags.
    environment = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    done = subprocess.run(
        [*command, "--output-directory", str(tmp_path), *house.PACKAGES],
        cwd=house.ROOT,
        env=environment,
        capture_output=True,
        text=True,
    )
    assert not done.returncode, done.stderr
    assert (done.stdout, done.stderr) == ("", "")
    files = [path for name in house.PACKAGES for path in house.Package(name).files]
    names = [path.parent if path.stem == "__init__" else path.with_suffix("") for path in files]
    pages = {path.relative_to(house.ROOT).with_suffix(".html").as_posix() for path in names}
    missing = {page for page in pages if not (tmp_path / page).is_file()}
    assert not missing
    assert 'id="run"' in (tmp_path / "jaxik.html").read_text(encoding="utf-8")
