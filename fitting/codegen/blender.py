"""Writes the add-on for Blender, whose modules are in `engines/blender`, as a zip."""

import sys
import zipfile
from importlib import metadata
from pathlib import Path

from fitting.runtime import files

SOURCES = Path(__file__).parent / "engines" / "blender"
MANIFEST = "blender_manifest.toml"
ENTRY = "addon.py"  # a package in the zip, but none here, where it could not be imported
ARCHIVE = "jaxik-blender.zip"


def write_addon(folder: str | Path) -> Path:
    """Writes the add-on for Blender 4.2 and newer, which installs it from disk.

    It calls the `jaxik` of the Python that runs this, unless its preferences name another.

    Args:
        folder: where it goes; it is made if missing.

    Returns:
        The path of the zip.

    Raises:
        ValueError: the zip cannot be written.
    """
    contents = {
        "__init__.py" if path.name == ENTRY else path.name: path.read_text(encoding="utf-8")
        for path in sorted(SOURCES.iterdir())
        if path.suffix in (".py", ".toml")
    }
    contents[MANIFEST] = contents[MANIFEST].replace("VERSION", metadata.version("jaxik"))
    contents["python.txt"] = sys.executable

    def fill(path: Path) -> None:
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, text in contents.items():
                archive.writestr(name, text)

    path = Path(folder) / ARCHIVE
    path.parent.mkdir(parents=True, exist_ok=True)
    files.write(path, fill)
    return path
