"""The experiments that come with the package, and copies of them with all of their files.

They lie in the folder `data` of the repository. A wheel has them in `fitting/examples`.
"""

import os
import tomllib
from pathlib import Path

import fitting
from fitting.experiments.schema.keys import FILE_KEYS
from fitting.runtime import files
from fitting.runtime.validation import check_keys

PACKAGE = Path(str(fitting.__file__)).parent
INSTALLED, REPOSITORY = PACKAGE / "examples", PACKAGE.parent / "data"
SCHEMA = "experiment.schema.json"  # beside a copied experiment, for editors


def names() -> dict[str, str]:
    """The names of the experiments whose files are all there, with their titles."""
    folder = _folder()
    titles = {}
    for path in sorted((folder / "experiments").rglob("*.toml")):
        content = tomllib.loads(path.read_text(encoding="utf-8"))
        if all(source.is_file() for source in _sources(path, content).values()):
            name = path.relative_to(folder / "experiments").with_suffix("").as_posix()
            titles[name] = content["name"]
    return titles


def path_of(name: str) -> Path:
    """The file of an experiment, where it is installed.

    Raises:
        ValueError: there is no such experiment.
    """
    check_keys({name: None}, list(names()), "jaxik example")
    return _folder() / "experiments" / f"{name}.toml"


def copy(name: str, folder: Path, schema: str) -> Path:
    """Copies an experiment, its clips and its terrain into a folder, which is made if missing.

    Args:
        name: of the experiment.
        folder: where they go; files that are there already stay as they are.
        schema: of experiment files, as JSON; the copy names it for editors.

    Returns:
        The path of the copied experiment.

    Raises:
        ValueError: there is no such experiment, or a file of it is already there.
        OSError: the folder cannot be made.
    """
    path = path_of(name)
    text = path.read_text(encoding="utf-8")
    sources = _sources(path, tomllib.loads(text))
    copies = {folder / path.name: b"", folder / SCHEMA: schema.encode()}
    for relative, source in sources.items():
        target = Path(source.parent.name, source.name)
        text = text.replace(f'"{relative}"', f'"{target.as_posix()}"')
        copies[folder / target] = source.read_bytes()
    copies[folder / path.name] = f"#:schema {SCHEMA}\n{text}".encode()
    if present := [str(target) for target in copies if target.exists()]:
        raise ValueError(f"{present[0]} is already there; give an empty folder with -o")
    for target, content in copies.items():
        target.parent.mkdir(parents=True, exist_ok=True)
        files.write(target, lambda temporary, content=content: temporary.write_bytes(content))
    return folder / path.name


def _folder() -> Path:
    """Where experiments, clips and terrains are."""
    return INSTALLED if INSTALLED.is_dir() else REPOSITORY


def _sources(path: Path, content: dict) -> dict[str, Path]:
    """The files that an experiment names, by how it writes their paths."""
    relative = [clip[key] for clip in content["clips"] for key in FILE_KEYS if key in clip]
    return {name: Path(os.path.normpath(path.parent / name)) for name in relative}
