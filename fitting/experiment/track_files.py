"""Track files: TOML with what changes along a clip, by its animation; the README shows one."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np

from fitting.clips import Clip
from fitting.runtime.declarations import LARGEST, NEEDED, Constraint, key, read
from fitting.runtime.validation import check_keys, read_toml

GROUNDED, WEIGHT = "grounded", "weight"
LATEST = 1e6  # s
A_LIST = Constraint("a list", lambda value: isinstance(value, list))


@dataclass(frozen=True)
class TrackTable:
    """A track as a file has it; its numbers are checked later, all at once."""

    times: Annotated[list, A_LIST] = key(
        NEEDED, "From the start of the file.", "s", wanted="a list of seconds"
    )
    values: Annotated[list, A_LIST] = key(
        NEEDED,
        "One for each time, or a list of one for each leg.",
        wanted="a list with a value for each time",
    )
    stepped: bool = key(False, "Whether each value holds until the next.")


@dataclass(frozen=True)
class Track:
    """Values at some times."""

    times: np.ndarray
    """s, (points,), ascending."""
    values: np.ndarray
    """(points,) or (points, legs)."""
    stepped: bool = False
    """Whether each value holds until the next; if not, values are linear between the times."""

    def at(self, seconds: np.ndarray) -> np.ndarray:
        """Values at other times (n,), s."""
        if self.stepped:
            last = np.searchsorted(self.times, seconds + 1e-9, side="right") - 1
            return self.values[np.maximum(last, 0)]
        columns = self.values.reshape(len(self.times), -1).T
        between = [np.interp(seconds, self.times, column) for column in columns]
        return np.stack(between, axis=-1).reshape(len(seconds), *self.values.shape[1:])


Tracks = Mapping[str, Track]  # by dotted name


def load_tracks(path: Path) -> dict[str, Track]:
    """Reads a track file.

    Raises:
        ValueError: no such file, not TOML, or a track whose times and values do not fit.
    """
    tables = read_toml(path, "a track")
    tracks: dict[str, Track] = {}
    for stage, table in tables.items():
        inner = table if isinstance(table, Mapping) else {stage: table}
        if "times" in inner or "values" in inner or not isinstance(table, Mapping):
            tracks[stage] = _track(table, f"{path} [{stage}]")
            continue
        for name, entry in inner.items():
            tracks[f"{stage}.{name}"] = _track(entry, f"{path} [{stage}.{name}]")
    return tracks


def along(clip: Clip, path: Path | None, start: float = 0.0) -> tuple[Clip, dict[str, np.ndarray]]:
    """The clip with the weights of a track file, and the parameters that change along it.

    Args:
        clip: with legs.
        path: of the track file; None has no tracks.
        start: time of the clip's first frame in the tracks, s.

    Returns:
        The clip, and arrays (frames, ...) by the parameters' dotted names.

    Raises:
        ValueError: as `load_tracks`, a leg that the clip does not have, or weights outside 0..1.
    """
    if path is None:
        return clip, {}
    seconds = start + np.arange(clip.frame_count) / clip.fps
    values = {name: track.at(seconds) for name, track in load_tracks(path).items()}
    names = clip.rig.names
    shape = (clip.frame_count, len(names))
    weight = np.ones(shape) if clip.weight is None else np.array(clip.weight)
    grounded = clip.grounded
    for name in [name for name in values if name.partition(".")[0] in (GROUNDED, WEIGHT)]:
        track, leg = values.pop(name), name.partition(".")[2]
        if not ((track >= 0.0) & (track <= 1.0)).all():
            raise ValueError(f"{path} [{name}]: values are outside 0 to 1")
        if track.ndim > 1:
            raise ValueError(f"{path} [{name}]: wanted one value for each time")
        if name == GROUNDED:
            grounded = track
            continue
        check_keys({leg: track} if leg else {}, names, f"{path} [{WEIGHT}]")
        weight[:, names.index(leg) if leg else slice(None)] = track if leg else track[:, None]
    return replace(clip, grounded=grounded, weight=weight), values


def _track(value: object, where: str) -> Track:
    table = read(value, TrackTable, where)
    try:
        times = np.asarray(table.times, np.float64)
        values = np.asarray(table.values, np.float64)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{where}: wanted numbers as times and values") from None
    if times.ndim != 1 or not times.size or len(values) != len(times):
        raise ValueError(f"{where}: {len(times)} times and {len(values)} values; wanted as many")
    if not (np.abs(times) <= LATEST).all() or not (np.diff(times) > 0).all():
        raise ValueError(
            f"{where}: times are {table.times}; wanted them ascending, to {LATEST:g} s at most"
        )
    if not values.size or values.ndim > 2:
        raise ValueError(f"{where}: values are {table.values}; wanted numbers, or lists of them")
    allowed = np.abs(values) <= LARGEST
    if not (allowed | (table.stepped & (values == np.inf))).all():
        raise ValueError(
            f"{where}: values are {table.values}; wanted numbers of at most {LARGEST:g}, or "
            "with stepped = true also inf"
        )
    return Track(times, values, table.stepped)
