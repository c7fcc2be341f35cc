"""The API reference is made from the docstrings by one command, without warnings."""

import subprocess
import sys

import house


def test_the_reference_has_a_page_for_every_module(tmp_path):
    command = [sys.executable, "-W", "error", "-m", "pdoc", "--docformat", "google"]
    done = subprocess.run(
        [*command, "--output-directory", str(tmp_path), *house.PACKAGES],
        cwd=house.ROOT,
        capture_output=True,
        text=True,
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    files = [path for name in house.PACKAGES for path in house.Package(name).files]
    names = [path.parent if path.stem == "__init__" else path.with_suffix("") for path in files]
    pages = {path.relative_to(house.ROOT).with_suffix(".html").as_posix() for path in names}
    missing = {page for page in pages if not (tmp_path / page).is_file()}
    assert not missing
    assert 'id="run"' in (tmp_path / "jaxik.html").read_text(encoding="utf-8")
