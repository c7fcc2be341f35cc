"""[[clips]] of an experiment file: which files there are, and how they are read."""

from collections.abc import Mapping
from pathlib import Path

from fitting.datasets.clips.joints.map_files import check_joint_map, read_joint_map
from fitting.experiments.experiment import ClipEntry
from fitting.experiments.schema.keys import CLIP_KEYS, FILE_KEYS
from fitting.runtime import validation
from fitting.runtime.validation import check_table, with_floats


def read_clip(value: object, path: Path) -> ClipEntry:
    """An entry of [[clips]].

    Args:
        value: what the file has there.
        path: of the file; relative paths start from its folder.

    Raises:
        ValueError: a key is unknown or missing, a value has the wrong type, a file does not exist,
            or an option belongs to none of the files.
    """
    table = check_table(value, CLIP_KEYS, f"{path} [[clips]]")
    entry = with_floats(table, ("start", "end", "scale", "terrain_scale", "terrain_cell"))
    for key in ("reference", "terrain"):
        if key not in table:
            raise ValueError(f"{path} [[clips]]: there is no {key}; it needs reference and terrain")
    has_joint_table = isinstance(table.get("joints"), Mapping)
    for key in (*FILE_KEYS, *(() if has_joint_table else ("joints",))):
        if key in table:
            entry[key] = (path.parent / table[key]).resolve()
            if reason := validation.why_unreadable(entry[key]):
                raise ValueError(f"{path} [[clips]]: {key} {table[key]!r}: {reason}")
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
