"""A game engine's binary foot-IK parameter record: its bytes, a CSV form, and its parameters.

The layout is little-endian: u8 knee axis at 0x0, flags in bits 0-2 at 0x1 (bits 3-7 are padding),
two bytes of padding, 31 consecutive f32 from 0x04 to 0x7c, and from 0x80 a tail of unknown length.
Everything that is read is kept, so that writing gives the same bytes again. Only this module knows
the record's spelling and units; `Reading` says how fields that are open to doubt are understood.
"""

import csv
import dataclasses
import io
import re
import struct
import warnings
from collections.abc import Callable
from typing import TypeVar

import jax.numpy as jnp
import numpy as np

from jaxik import presets
from jaxik.maths import parameter_tree
from jaxik.pipeline import FootIK
from jaxik.world.skeleton import Rig

Value = TypeVar("Value")

SIZE = 0x80  # bytes, without the tail
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
    """How to understand the fields whose unit or sign the record does not state.

    Attributes:
        length_unit: unit of planted and raised heights and of ray lengths: "m", "cm", or "auto",
            which warns and takes centimetres if a planted height is over 1 or a ray over 5, more
            than any body of 1.8 m has in metres.
        knee_convention: "interior" (pi is a straight leg) or "flexion" (0 is a straight leg).
        lean_sign: 1 if a positive rate aligns the body with the ground's normal, -1 if it leans
            into the hill.
        tick_hz: the game's rate, to which all gains refer.
    """

    length_unit: str = "auto"
    knee_convention: str = "interior"
    lean_sign: int = 1
    tick_hz: float = 30.0  # Hz

    def __post_init__(self) -> None:
        for name, allowed in (
            ("length_unit", ("auto", "m", "cm")),
            ("knee_convention", ("interior", "flexion")),
            ("lean_sign", (1, -1)),
        ):
            if (value := getattr(self, name)) not in allowed:
                raise ValueError(f"{name} is {value!r}; it is one of {allowed}")
        if not self.tick_hz > 0:
            raise ValueError(f"tick_hz is {self.tick_hz}; it is the game's rate, above 0")


@dataclasses.dataclass(frozen=True)
class Record:
    """A record as it is stored."""

    knee_axis_type: int = 2
    flags: int = 0b111  # bits 0-2, and the padding bits 3-7
    padding: bytes = b"\0\0"
    floats: tuple[bytes, ...] = (b"\0\0\0\0",) * len(FLOATS)  # as stored: NaN payloads survive
    tail: bytes = b""

    def __post_init__(self) -> None:
        for name in ("knee_axis_type", "flags"):
            if not 0 <= (value := getattr(self, name)) <= 0xFF:
                raise ValueError(f"{name} is {value}; it is one byte, 0 to 255")
        sizes, expected = list(map(len, (self.padding, *self.floats))), [2] + [4] * len(FLOATS)
        if sizes != expected:
            raise ValueError(f"padding and floats have {expected} bytes; these have {sizes}")

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
    """The record in these bytes; everything from 0x80 on becomes its tail.

    Raises:
        ValueError: for fewer than 0x80 bytes.
    """
    if len(data) < SIZE:
        raise ValueError(f"a foot-IK record has at least {SIZE} bytes; these are {len(data)}")
    floats = tuple(data[start : start + 4] for start in range(4, SIZE, 4))
    return Record(data[0], data[1], data[2:4], floats, data[SIZE:])


def to_bytes(record: Record) -> bytes:
    """The bytes of a record: those it was read from."""
    head = bytes([record.knee_axis_type, record.flags]) + record.padding
    return head + b"".join(record.floats) + record.tail


def to_ik(record: Record, reading: Reading | None = None) -> FootIK:
    """The record preset with a record's parameters; those that it lacks keep their defaults.

    Raises:
        ValueError: if a number is not finite or the knee axis is unknown.
    """
    reading = reading or Reading()
    knee_axis(record)
    values: dict[str, float] = {}
    for name, ours, unit in _fields(reading):
        if not np.isfinite(stored := record.value(name)):
            raise ValueError(f"{name} is {stored}; the record's floats are finite numbers")
        values[ours] = _from_stored(name, stored, unit, record, reading)
    toe = [values.pop(f"probe.toe_ls[{axis}]") for axis in range(3)]
    switches = {ours: record.flag(name) for _, name, ours in FLAGS}
    ticks = {name: reading.tick_hz for name in ("lean.tick_hz", "pelvis.tick_hz")}
    return parameter_tree.replace(
        presets.record(), values | {"probe.toe_ls": toe} | switches | ticks
    )


def from_ik(ik: FootIK, base: Record | None = None, reading: Reading | None = None) -> Record:
    """The record with a system's parameters.

    Args:
        ik: a system with the rules of the record preset.
        base: where knee axis, padding and tail come from. A float whose value is the same in `base`
            and `ik` keeps its bytes.
        reading: units and signs to write. With `length_unit` "auto" lengths get the unit of `base`,
            or metres.

    Raises:
        ValueError: if a parameter differs between legs, does not fit a 32-bit float, or would be
            read back in another unit.
    """
    reading = reading or Reading()
    template = base or Record()
    flags = template.flags & ~0b111
    for bit, _, ours in FLAGS:
        flags |= int(_shared_value(ik, ours)) << bit
    automatic_unit = reading.length_unit == "auto"
    if automatic_unit:
        length_unit = "cm" if base is not None and _in_centimetres(base) else "m"
        reading = dataclasses.replace(reading, length_unit=length_unit)
    floats = []
    for index, (name, ours, unit) in enumerate(_fields(reading)):
        value = _shared_value(ik, ours)
        stored = _packed(_to_stored(value, unit, reading))
        if base is not None and np.isfinite(base.value(name)):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                before = _from_stored(name, base.value(name), unit, base, reading)
            if np.isclose(before, value, rtol=1e-6, atol=1e-7):
                stored = base.floats[index]
        floats.append(stored)
    record = dataclasses.replace(template, flags=flags, floats=tuple(floats))
    if automatic_unit and _in_centimetres(record) != (reading.length_unit == "cm"):
        raise ValueError(
            f"lengths written in {reading.length_unit} would be read in the other unit, because a "
            'planted height over 1 or a ray over 5 counts as cm; set length_unit to "m" or "cm"'
        )
    return record


def knee_axis(record: Record) -> np.ndarray:
    """The hinge of the knee in knee space, unit (3,)."""
    if record.knee_axis_type >= len(KNEE_AXES):
        raise ValueError(f"kneeAxisType is {record.knee_axis_type}; 0 to 5 are +X +Y +Z -X -Y -Z")
    return KNEE_AXES[record.knee_axis_type]


def with_knee_axis(rig: Rig, record: Record) -> Rig:
    """The rig with the record's knee axis, for a game skeleton.

    Not for rigs that were measured from a captured clip: these have their own axes.
    """
    axis = jnp.asarray(knee_axis(record), rig.knee_axis_ls.dtype)
    return dataclasses.replace(rig, knee_axis_ls=jnp.broadcast_to(axis, rig.knee_axis_ls.shape))


def to_csv(records: list[Record]) -> str:
    """CSV text with a row per record, the record's own names, and padding in hexadecimal."""
    out = io.StringIO()
    rows = csv.writer(out, lineterminator="\n")
    rows.writerow(COLUMNS)
    for record in records:
        flags = [int(record.flag(name)) for name in FLAG_NAMES]
        head = [record.knee_axis_type, *flags, record.flags >> 3, record.padding.hex()]
        rows.writerow([*head, *map(_shortest, record.floats), record.tail.hex()])
    return out.getvalue()


def from_csv(text: str) -> list[Record]:
    """The records in CSV text; columns may be in any order, and those of padding may be missing.

    Raises:
        ValueError: naming the row and column at fault.
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
    for values in rows:
        cells = _Cells(f"row {rows.line_num}", values)
        if None in values or None in values.values():
            raise ValueError(f"{cells.row} has not the {len(columns)} cells of the header")
        flags = cells.read("padflag", _whole(0x1F), "a whole number from 0 to 31", "0") << 3
        for bit, name, _ in FLAGS:
            flags |= cells.read(name, _whole(1), "0 or 1") << bit
        axis = cells.read("kneeAxisType", _whole(0xFF), "a whole number from 0 to 255")
        floats = tuple(cells.read(name, _packed, "a 32-bit number") for name in FLOAT_NAMES)
        padding = cells.read("pad1", bytes.fromhex, "bytes in hexadecimal", "0000")
        tail = cells.read("pad3", bytes.fromhex, "bytes in hexadecimal")
        if len(padding) != 2:
            raise ValueError(f"{cells.row}, column pad1: {padding.hex()!r} is not two bytes")
        records.append(Record(axis, flags, padding, floats, tail))
    return records


@dataclasses.dataclass(frozen=True)
class _Cells:
    """One row of a CSV."""

    row: str  # such as "row 2"
    values: dict[str, str]

    def read(
        self, name: str, convert: Callable[[str], Value], expected: str, default: str = ""
    ) -> Value:
        """A cell, converted; an empty or missing one is read as `default`."""
        cell = (self.values.get(name) or default).strip()
        try:
            return convert(cell)
        except ValueError:
            raise ValueError(f"{self.row}, column {name}: {cell!r} is not {expected}") from None


def _whole(maximum: int) -> Callable[[str], int]:
    """A reader of whole numbers from 0 to `maximum`."""
    return lambda cell: range(maximum + 1).index(int(cell))


def _shortest(stored: bytes) -> str:
    """The shortest decimal that reads back as the same f32; for a NaN with a payload, its bits."""
    value = np.frombuffer(stored, "<f4")[0]
    if np.isnan(value) and stored != QUIET_NAN:
        return f"nan(0x{stored[::-1].hex()})"
    return str(value)


def _packed(value: float | str) -> bytes:
    """The bytes of the f32 nearest to a number or its text; a ValueError if there is none."""
    if isinstance(value, str) and (bits := re.fullmatch(r"nan\(0x([0-9a-fA-F]{8})\)", value)):
        return bytes.fromhex(bits[1])[::-1]
    number = float(value)
    try:
        return QUIET_NAN if np.isnan(number) else struct.pack("<f", number)
    except OverflowError:
        raise ValueError(f"{value} is beyond a 32-bit float") from None


def _fields(reading: Reading) -> list[tuple[str, str, str]]:
    """`FLOATS` for a reading: the largest flexion is the smallest interior angle."""
    if reading.knee_convention == "interior":
        return list(FLOATS)
    other = {"leg.max_knee_angle": "leg.min_knee_angle", "leg.min_knee_angle": "leg.max_knee_angle"}
    return [(name, other.get(ours, ours), unit) for name, ours, unit in FLOATS]


def _shared_value(ik: FootIK, name: str) -> float:
    """The value of a parameter, which must be the same for all legs."""
    leaf, _, index = name.rstrip("]").partition("[")
    values = np.asarray(parameter_tree.get(ik, leaf))
    values = np.unique(values[..., int(index)] if index else values)
    if len(values) > 1:
        raise ValueError(f"{name} is {values.tolist()}; the record has one value for all legs")
    return float(values[0])


def _in_centimetres(record: Record) -> bool:
    """Whether lengths can only be in centimetres, for a body of 1.8 m."""
    rays = max(record.value("raycastDistanceUp"), record.value("raycastDistanceDown"))
    return record.value("footPlantedAnkleHeightMS") > 1.0 or rays > 5.0


def _from_stored(name: str, value: float, unit: str, record: Record, reading: Reading) -> float:
    """A stored number in our units: metres, radians, gains per tick."""
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


def _to_stored(value: float, unit: str, reading: Reading) -> float:
    """A number in our units as the record stores it."""
    if unit == "length" and reading.length_unit == "cm":
        return value * 100.0
    if unit == "cosine":
        return float(np.cos(value if reading.knee_convention == "interior" else np.pi - value))
    if unit == "deg":
        return float(np.degrees(value))
    if unit == "lean":
        return reading.lean_sign * value
    return value
