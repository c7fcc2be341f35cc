"""[[clips]] of an experiment file: which files there are, and how they are read."""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from fitting.datasets.clips.joints.map_files import check_joint_map, read_joint_map
from fitting.experiments.experiment import ClipEntry
from fitting.experiments.schema.keys import CLIP_KEYS, FILE_KEYS
from fitting.runtime import validation
from fitting.runtime.validation import check_table, with_floats


class Places(NamedTuple):
    """An experiment file, and where relative paths in it may start."""

    file: Path
    written_in: str | None = None
    """The folder in which it was written, from where its paths led."""

    def find(self, path: str, what: str) -> Path:
        """The file that a path names: from the experiment file, or else from where that was.

        Args:
            path: as the experiment file has it.
            what: the key that has it, for the error message.

        Raises:
            ValueError: there is no file to read at either place.
        """
        here = (self.file.parent / path).resolve()
        reason = validation.why_unreadable(here)
        if not reason:
            return here
        if self.written_in is not None:
            before = (Path(self.written_in) / path).resolve()
            if not validation.why_unreadable(before):
                return before
            if before != here:
                reason += f" at {here}, nor at {before}, to where it led when this was written"
        raise ValueError(f"{self.file} [[clips]]: {what} {path!r}: {reason}")


def read_clip(value: object, places: Places) -> ClipEntry:
    """An entry of [[clips]].

    Args:
        value: what the file has there.
        places: the file, and where its paths start.

    Raises:
        ValueError: a key is unknown or missing, a value has the wrong type, a file does not exist,
            or an option belongs to none of the files.
    """
    path = places.file
    table = check_table(value, CLIP_KEYS, f"{path} [[clips]]")
    entry = with_floats(table, ("start", "end", "scale", "sole", "terrain_scale", "terrain_cell"))
    for key in ("reference", "terrain"):
        if key not in table:
            raise ValueError(f"{path} [[clips]]: there is no {key}; it needs reference and terrain")
    has_joint_table = isinstance(table.get("joints"), Mapping)
    for key in (*FILE_KEYS, *(() if has_joint_table else ("joints",))):
        if key in table:
            entry[key] = places.find(table[key], key)
    if "end" in table and table["end"] <= table.get("start", 0.0):
        raise ValueError(
            f"{path} [[clips]]: end is {table['end']}; wanted more than start, which is "
            f"{table.get('start', 0.0)}"
        )
    if has_joint_table:
        entry["joints"] = check_joint_map(table["joints"], f"{path} [[clips]] joints")
    elif "joints" in table:
        read_joint_map(entry["joints"])  # reports mistakes before any clip is read
    if "terrain_offset" in table:
        entry["terrain_offset"] = tuple(float(number) for number in table["terrain_offset"])
    clip = ClipEntry(**entry)
    files = [clip.reference] if clip.base is None else [clip.reference, clip.base]
    clip.clip_options.check_use(files, f"{path} [[clips]]")
    return clip
