"""Writes parameters for others, and copies of the experiments that come with the package.

Those lie in the folder `data` of the repository. A wheel has them in `fitting/examples`.
"""

import os
import sys
import tomllib
import zipfile
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

import fitting
import jaxik
from fitting import codegen
from fitting.clips.clip_frames import frames_from_clip
from fitting.codegen.export import GoldenTrace, export_system
from fitting.codegen.program import blank_rig
from fitting.experiment import originals, parameter_files, record_files
from fitting.experiment.experiment import ClipEntry
from fitting.experiment.systems import Preset
from fitting.ground.meshes import load_terrain
from fitting.motion.flat_animation import load_flat_animation
from fitting.runtime import files
from fitting.runtime.declarations import PATH, keys
from fitting.runtime.precision import in_float64
from fitting.runtime.validation import check_keys, error_context
from jaxik import record

from .fit import run_folder

OURS = (".toml", ".json", ".csv", ".bin")  # parameters, parameters, record, record

PACKAGE = Path(str(fitting.__file__)).parent
INSTALLED, REPOSITORY = PACKAGE / "examples", PACKAGE.parent / "data"
SCHEMA = "experiment.schema.json"  # beside a copied experiment, for editors

ADDON = Path(str(codegen.__file__)).parent / "engines" / "blender"
MANIFEST = "blender_manifest.toml"
ENTRY = "addon.py"  # a package in the zip, but none there, where it could not be imported
ARCHIVE = "jaxik-blender.zip"


class Source(NamedTuple):
    """A system, with its preset and the body that its numbers are for."""

    ik: jaxik.FootIK
    preset: Preset
    leg_length: float | None = None
    """m, of the body that its numbers are for; None if they fit any body as they are."""


@in_float64
def export(
    source: str | Path, output: str | Path, *, system: str | None = None, drop: bool = False
) -> None:
    """Writes parameters in another form, which the ending of the output chooses.

    Args:
        source: the folder of a run, a parameter file (.toml, .json), a record (.bin, .csv), or a
            table of settings (.toml, .json, .csv).
        output: .toml or .json for parameters, .bin or .csv for the game's record; with a system,
            .toml, .json or .csv for its settings.
        system: whose settings are written, under its own names and in its own units: "ozz",
            "unreal" or "mec". None writes parameters or a record.
        drop: whether to leave out, with a warning, what a record or the settings cannot hold.

    Raises:
        ValueError: the source cannot be read, the output has another ending or cannot be written,
            or cannot hold all parameters and they are not to be left out.
    """
    source, output = Path(source), Path(output)
    suffix = output.suffix.lower()
    _check_suffix(output, OURS if system is None else originals.SUFFIXES)
    if system is not None:
        originals.original_of(system)
    files.check_output_file(output)
    loaded = load(source)
    if system is not None:
        with error_context(source):
            values = originals.to_settings(loaded.ik, system, drop=drop)
            files.write_text(output, originals.settings_text(values, system, suffix))
    elif suffix == ".toml":
        files.write_text(output, parameter_files.system_to_toml(*loaded))
    elif suffix == ".json":
        files.write_text(output, parameter_files.system_to_json(*loaded))
    else:
        units = record.Reading(length_unit="m")
        content = record_files.from_system(loaded.ik, loaded.preset, source, units, drop=drop)
        if suffix == ".csv":
            files.write_text(output, record.to_csv([content]))
        else:
            files.write(output, lambda path: path.write_bytes(record.to_bytes(content)))


def export_code(
    source: str | Path,
    folder: str | Path,
    *,
    language: str = "c",
    name: str = "footik",
    axes: str | None = None,
    legs: int = 2,
    trace: Path | None = None,
    terrain: Path | None = None,
) -> None:
    """Writes a system as code with the answers of `jaxik.step`; see `fitting.codegen`.

    Args:
        source: as for `export`.
        folder: where the files go; it is made if missing.
        language: as for `fitting.export_system`.
        name: of the files, and prefix of all names in them.
        axes: as for `fitting.export_system`.
        legs: how many legs a character has; with a trace, as many as in its clip.
        trace: a clip of which a golden trace is written, with a program that replays it; None
            writes neither.
        terrain: under that clip; None is a level floor.

    Raises:
        ValueError: the source or the clip cannot be read, the system cannot be exported, or the
            folder cannot be made.
    """
    run_folder.check_output_folder(Path(folder))
    loaded = load(Path(source))
    if trace is None:
        rig, golden = blank_rig(legs), None
    else:
        clip = load_flat_animation(trace)
        ground = jaxik.world.terrain.plane() if terrain is None else load_terrain(terrain)
        rig, golden = clip.rig, GoldenTrace(ground, frames_from_clip(clip))
    with error_context(source):
        export_system(
            loaded.ik, rig, folder, language=language, name=name, axes=axes, golden=golden
        )


def export_blender_addon(folder: str | Path) -> Path:
    """Writes the add-on for Blender 4.2 and newer as a zip, which Blender installs from disk.

    It calls the `jaxik` of the Python that runs this, unless its preferences name another.

    Args:
        folder: where the zip goes; it is made if missing.

    Returns:
        The path of the zip.

    Raises:
        ValueError: the folder cannot be made, or the zip cannot be written.
    """
    run_folder.check_output_folder(Path(folder))
    contents = {
        "__init__.py" if path.name == ENTRY else path.name: path.read_text(encoding="utf-8")
        for path in sorted(ADDON.iterdir())
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


def load(source: Path) -> Source:
    """The system in a run, a parameter file, a record or a table of settings.

    Raises:
        ValueError: there is none, or it cannot be read.
    """
    if source.is_dir():
        run_folder.load_fitted_system(source)  # says what is wrong with a run
        return _load_parameters(source / run_folder.PARAMETERS)
    if originals.has_settings(source):
        ik, name = originals.load_settings(source)
        return Source(ik, originals.ORIGINALS[name].preset)
    if source.suffix.lower() in (".toml", ".json"):
        return _load_parameters(source)
    (only, *more) = record_files.read(source, record.Reading(), None, drop=False)
    if more:
        raise ValueError(f"{source} has {1 + len(more)} rows; give a file with one record")
    with error_context(source):
        return Source(record.to_ik(only), Preset("record", faithful=True))


def _load_parameters(path: Path) -> Source:
    ik, preset = parameter_files.load_system(path)
    return Source(ik, preset, parameter_files.leg_length_of(path))


def _check_suffix(output: Path, suffixes: Sequence[str]) -> None:
    if output.suffix.lower() not in suffixes:
        raise ValueError(f"{output}: wanted a name that ends in one of {list(suffixes)}")


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
    known = [name for name, declared in keys(ClipEntry).items() if declared.constraint is PATH]
    relative = [clip[name] for clip in content["clips"] for name in known if name in clip]
    return {name: Path(os.path.normpath(path.parent / name)) for name in relative}
