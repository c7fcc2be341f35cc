"""The game's foot-IK parameter record: bytes, CSV text, and the parameters it means.

Little-endian: u8 knee axis at 0x0, flags in bits 0-2 at 0x1 (3-7 padding), two bytes of padding, 31
consecutive f32 from 0x04 to 0x7c, and from 0x80 a tail of unknown length. Everything that is read
is kept, so that writing gives the same bytes again. The record's spelling and units live here only.
Numbers like A1 name the settled questions of systems.md, section 4.
"""

import csv
import dataclasses
import io
import re
import struct
import warnings
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxik import presets
from jaxik.maths import parameter_tree
from jaxik.pipeline import FootIK
from jaxik.world.skeleton import Rig

SIZE = 0x80
FLAGS = (  # bit at 0x1, name in the record, our name
    (0, "useFootLocking", "lock.enabled"),
    (1, "useFootEndRay", "probe.use_toe"),
    (2, "heightOffsetUpDir", "pelvis.vertical_only"),
)
FLOATS = (  # name in the record, in the order of the offsets; our name; unit at the border
    ("originalGroundHeightMS", "contact.ground_height", "m"),
    ("minAnkleHeightMS", "target.min_ankle_height", "m"),
    ("maxAnkleHeightMS", "target.max_ankle_height", "m"),
    ("cosineMaxKneeAngle", "leg.max_knee_angle", "cosine"),
    ("cosineMinKneeAngle", "leg.min_knee_angle", "cosine"),
    ("footPlantedAnkleHeightMS", "contact.planted_height", "length"),
    ("footRaisedAnkleHeightMS", "contact.raised_height", "length"),
    ("raycastDistanceUp", "probe.ray_up", "length"),
    ("raycastDistanceDown", "probe.ray_down", "length"),
    ("footEndLS_X", "probe.toe_ls[0]", "m"),
    ("footEndLS_Y", "probe.toe_ls[1]", "m"),
    ("footEndLS_Z", "probe.toe_ls[2]", "m"),
    ("maxFootPitchRadians", "foot.max_pitch", "rad"),
    ("minFootPitchRadians", "foot.min_pitch", "rad"),
    ("maxFootRollRadians", "foot.max_roll", "rad"),
    ("minFootRollRadians", "foot.min_roll", "rad"),
    ("heightOffsetLimit", "pelvis.limit", "m"),
    ("heightOffsetOnGain", "pelvis.on_gain", "1"),
    ("heightOffsetOffGain", "pelvis.off_gain", "1"),
    ("forwardUndulationRate", "lean.forward_rate", "lean"),
    ("sideUndulationRate", "lean.side_rate", "lean"),
    ("forwardUndulationRateSlide", "lean.forward_rate_slide", "lean"),
    ("sideUndulationRateSlide", "lean.side_rate_slide", "lean"),
    ("undulationGain", "lean.gain", "1"),
    ("undulationGainSlide", "lean.gain_slide", "1"),
    ("undulationGainDefaultToSlide", "lean.slide_on_gain", "1"),
    ("undulationGainSlideToDefault", "lean.slide_off_gain", "1"),
    ("lockedDisableMinAngle", "lock.release_min_angle", "deg"),
    ("lockedDisableMaxAngle", "lock.release_max_angle", "deg"),
    ("lockedDisableDirAngle", "lock.release_cone", "deg"),
    ("nextLockFactorThreshold", "lock.relock_threshold", "1"),
)
FLOAT_NAMES = tuple(name for name, _, _ in FLOATS)
FLAG_NAMES = tuple(name for _, name, _ in FLAGS)
COLUMNS = ("kneeAxisType", *FLAG_NAMES, "padflag", "pad1", *FLOAT_NAMES, "pad3")
KNEE_AXES = np.concatenate([np.eye(3), -np.eye(3)])  # by kneeAxisType
QUIET_NAN = b"\0\0\xc0\x7f"  # what "nan" reads as


@dataclasses.dataclass(frozen=True)
class Reading:
    """How the record's doubtful fields are read."""

    length_unit: str = "auto"  # A1: auto, m or cm
    knee_convention: str = "interior"  # A3: interior or flexion
    lean_sign: int = 1  # A6: 1 or -1
    tick_hz: float = 30.0  # A5

    def __post_init__(self) -> None:
        for name, allowed in (
            ("length_unit", ("auto", "m", "cm")),
            ("knee_convention", ("interior", "flexion")),
            ("lean_sign", (1, -1)),
        ):
            if (came := getattr(self, name)) not in allowed:
                raise ValueError(f"{name} is {came!r}; it is one of {allowed}")
        if not self.tick_hz > 0:
            raise ValueError(f"tick_hz is {self.tick_hz}; it is the game's rate, above 0")


@dataclasses.dataclass(frozen=True)
class Record:
    """The record as it is stored."""

    knee_axis_type: int = 2
    flags: int = 0b111  # bits 0-2, and the padding bits 3-7
    padding: bytes = b"\0\0"
    floats: tuple[bytes, ...] = (b"\0\0\0\0",) * len(FLOATS)  # as stored: NaN payloads survive
    tail: bytes = b""

    def __post_init__(self) -> None:
        for name in ("knee_axis_type", "flags"):
            if not 0 <= (came := getattr(self, name)) <= 0xFF:
                raise ValueError(f"{name} is {came}; it is one byte, 0 to 255")
        came, wanted = list(map(len, (self.padding, *self.floats))), [2] + [4] * len(FLOATS)
        if came != wanted:
            raise ValueError(f"padding and floats have {wanted} bytes; these have {came}")

    def value(self, name: str) -> float:
        """A float by its name in the record."""
        if name not in FLOAT_NAMES:
            raise ValueError(f"the record has no float {name!r}; it has {list(FLOAT_NAMES)}")
        return struct.unpack("<f", self.floats[FLOAT_NAMES.index(name)])[0]

    def flag(self, name: str) -> bool:
        """A flag by its name in the record."""
        if name not in FLAG_NAMES:
            raise ValueError(f"the record has no flag {name!r}; it has {list(FLAG_NAMES)}")
        return bool(self.flags >> FLAG_NAMES.index(name) & 1)


def from_bytes(data: bytes) -> Record:
    """The record in these bytes; everything from 0x80 on is kept as its tail.

    Raises:
        ValueError: for fewer than 0x80 bytes.
    """
    if len(data) < SIZE:
        raise ValueError(f"a foot-IK record has at least {SIZE} bytes; these are {len(data)}")
    floats = tuple(data[start : start + 4] for start in range(4, SIZE, 4))
    return Record(data[0], data[1], data[2:4], floats, data[SIZE:])


def to_bytes(record: Record) -> bytes:
    """The bytes of a record, as they were read."""
    head = bytes([record.knee_axis_type, record.flags]) + record.padding
    return head + b"".join(record.floats) + record.tail


def to_ik(record: Record, reading: Reading | None = None) -> FootIK:
    """The pipeline with the record's parameters; those that it lacks keep their defaults.

    Raises:
        ValueError: for a number that is not finite, or an unknown knee axis.
    """
    reading = reading or Reading()
    knee_axis(record)
    values: dict[str, float] = {}
    for name, ours, unit in _fields(reading):
        if not np.isfinite(stored := record.value(name)):
            raise ValueError(f"{name} is {stored}; the record's floats are finite numbers")
        values[ours] = _inside(name, stored, unit, record, reading)
    toe = [values.pop(f"probe.toe_ls[{axis}]") for axis in range(3)]
    switches = {ours: record.flag(name) for _, name, ours in FLAGS}
    ticks = {name: reading.tick_hz for name in ("lean.tick_hz", "pelvis.tick_hz")}
    return parameter_tree.replace(
        presets.record(), values | {"probe.toe_ls": toe} | switches | ticks
    )


def from_ik(ik: FootIK, base: Record | None = None, reading: Reading | None = None) -> Record:
    """The record that holds the pipeline's parameters.

    `base` gives the knee axis, the padding and the tail; a float that means in `base` what it means
    in `ik` keeps its bytes. With `length_unit` "auto" the unit is that of `base`, else metres.

    Raises:
        ValueError: for a parameter that differs between legs, is beyond a 32-bit float, or would be
            read back in another unit.
    """
    reading = reading or Reading()
    kept = base or Record()
    flags = kept.flags & ~0b111
    for bit, _, ours in FLAGS:
        flags |= int(_leaf(ik, ours)) << bit
    guessed = reading.length_unit == "auto"
    if guessed:
        length_unit = "cm" if base is not None and _in_centimetres(base) else "m"
        reading = dataclasses.replace(reading, length_unit=length_unit)
    floats = []
    for index, (name, ours, unit) in enumerate(_fields(reading)):
        value = _leaf(ik, ours)
        stored = _packed(_outside(value, unit, reading))
        if base is not None and np.isfinite(base.value(name)):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                before = _inside(name, base.value(name), unit, base, reading)
            if np.isclose(before, value, rtol=1e-6, atol=1e-7):
                stored = base.floats[index]
        floats.append(stored)
    made = dataclasses.replace(kept, flags=flags, floats=tuple(floats))
    if guessed and _in_centimetres(made) != (reading.length_unit == "cm"):
        raise ValueError(
            f"lengths written in {reading.length_unit} would be read in the other unit: a planted "
            'height over 1 or a ray over 5 counts as cm; give length_unit "m" or "cm"'
        )
    return made


def knee_axis(record: Record) -> np.ndarray:
    """The knee's hinge in its joint's space, unit (3,)."""
    if record.knee_axis_type >= len(KNEE_AXES):
        raise ValueError(f"kneeAxisType is {record.knee_axis_type}; 0 to 5 are +X +Y +Z -X -Y -Z")
    return KNEE_AXES[record.knee_axis_type]


def with_knee_axis(rig: Rig, record: Record) -> Rig:
    """The rig of a game skeleton, whose knees turn about the record's axis.

    A rig measured from a captured clip has its own axes and does not need this.
    """
    axis = jnp.asarray(knee_axis(record), rig.knee_axis_ls.dtype)
    return dataclasses.replace(rig, knee_axis_ls=jnp.broadcast_to(axis, rig.knee_axis_ls.shape))


def to_csv(records: list[Record]) -> str:
    """One row a record under the record's own names; padding in hexadecimal."""
    out = io.StringIO()
    rows = csv.writer(out, lineterminator="\n")
    rows.writerow(COLUMNS)
    for record in records:
        flags = [int(record.flag(name)) for name in FLAG_NAMES]
        head = [record.knee_axis_type, *flags, record.flags >> 3, record.padding.hex()]
        rows.writerow([*head, *map(_shortest, record.floats), record.tail.hex()])
    return out.getvalue()


def from_csv(text: str) -> list[Record]:
    """The records of a CSV; a column that is missing is an error, padding excepted.

    Raises:
        ValueError: naming row and column.
    """
    rows = csv.DictReader(io.StringIO(text))
    columns = list(rows.fieldnames or [])
    needed = [name for name in COLUMNS if not name.startswith("pad")]
    if missing := [name for name in needed if name not in columns]:
        raise ValueError(f"the CSV has no column {missing}; it has {columns}")
    if unknown := [name for name in columns if name not in COLUMNS]:
        raise ValueError(f"the CSV has unknown columns {unknown}; a record has {list(COLUMNS)}")
    if twice := [name for name in COLUMNS if columns.count(name) > 1]:
        raise ValueError(f"the CSV has column {twice} more than once")
    records = []
    for cells in rows:
        line = f"row {rows.line_num}"
        if None in cells or None in cells.values():
            raise ValueError(f"{line} has not the {len(columns)} cells of the header")
        flags = _read(line, cells, "padflag", _whole(0x1F), "a whole number from 0 to 31", "0") << 3
        for bit, name, _ in FLAGS:
            flags |= _read(line, cells, name, _whole(1), "0 or 1") << bit
        axis = _read(line, cells, "kneeAxisType", _whole(0xFF), "a whole number from 0 to 255")
        floats = tuple(_read(line, cells, name, _packed, "a 32-bit number") for name in FLOAT_NAMES)
        padding = _read(line, cells, "pad1", bytes.fromhex, "bytes in hexadecimal", "0000")
        tail = _read(line, cells, "pad3", bytes.fromhex, "bytes in hexadecimal")
        if len(padding) != 2:
            raise ValueError(f"{line}, column pad1: {padding.hex()!r} is not two bytes")
        records.append(Record(axis, flags, padding, floats, tail))
    return records


def _read(
    line: str, cells: dict, name: str, convert: Callable, wanted: str, missing: str = ""
) -> Any:
    cell = (cells.get(name) or missing).strip()
    try:
        return convert(cell)
    except ValueError:
        raise ValueError(f"{line}, column {name}: {cell!r} is not {wanted}") from None


def _whole(most: int) -> Callable[[str], int]:
    return lambda cell: range(most + 1).index(int(cell))


def _shortest(stored: bytes) -> str:
    """The shortest decimal that reads back as the same f32; all bits of a NaN that is not plain."""
    value = np.frombuffer(stored, "<f4")[0]
    if np.isnan(value) and stored != QUIET_NAN:
        return f"nan(0x{stored[::-1].hex()})"
    return str(value)


def _packed(value: float | str) -> bytes:
    """The f32 nearest to a number or its text; a ValueError where there is none."""
    if isinstance(value, str) and (bits := re.fullmatch(r"nan\(0x([0-9a-fA-F]{8})\)", value)):
        return bytes.fromhex(bits[1])[::-1]
    number = float(value)
    try:
        return QUIET_NAN if np.isnan(number) else struct.pack("<f", number)
    except OverflowError:
        raise ValueError(f"{value} is beyond a 32-bit float") from None


def _fields(reading: Reading) -> list[tuple[str, str, str]]:
    """`FLOATS`, for a reading: a knee's largest flexion is its smallest interior angle (A3)."""
    if reading.knee_convention == "interior":
        return list(FLOATS)
    other = {"leg.max_knee_angle": "leg.min_knee_angle", "leg.min_knee_angle": "leg.max_knee_angle"}
    return [(name, other.get(ours, ours), unit) for name, ours, unit in FLOATS]


def _leaf(ik: FootIK, name: str) -> float:
    """A number that all legs share."""
    leaf, _, index = name.rstrip("]").partition("[")
    values = np.asarray(parameter_tree.get(ik, leaf))
    values = np.unique(values[..., int(index)] if index else values)
    if len(values) > 1:
        raise ValueError(f"{name} is {values.tolist()}; the record has one value for all legs")
    return float(values[0])


def _in_centimetres(record: Record) -> bool:
    """A1: planted over 1 or a ray over 5 can only be centimetres for a body of 1.8 m."""
    rays = max(record.value("raycastDistanceUp"), record.value("raycastDistanceDown"))
    return record.value("footPlantedAnkleHeightMS") > 1.0 or rays > 5.0


def _inside(name: str, value: float, unit: str, record: Record, reading: Reading) -> float:
    """A stored number in metres, radians and gains."""
    if unit == "length":
        if reading.length_unit == "cm":
            return value / 100.0
        if reading.length_unit == "auto" and _in_centimetres(record):
            warnings.warn(f"{name} = {value} is read as centimetres", stacklevel=3)
            return value / 100.0
    if unit == "cosine":
        if abs(value) > 1.0:
            warnings.warn(f"{name} = {value} is no cosine; it is read as degrees", stacklevel=3)
            angle = np.radians(value)
        else:
            angle = np.arccos(value)
        return float(angle if reading.knee_convention == "interior" else np.pi - angle)
    if unit == "deg":
        return float(np.radians(value))
    if unit == "lean":
        return reading.lean_sign * value
    return value


def _outside(value: float, unit: str, reading: Reading) -> float:
    """Metres, radians and gains as the record stores them."""
    if unit == "length" and reading.length_unit == "cm":
        return value * 100.0
    if unit == "cosine":
        return float(np.cos(value if reading.knee_convention == "interior" else np.pi - value))
    if unit == "deg":
        return float(np.degrees(value))
    if unit == "lean":
        return reading.lean_sign * value
    return value
