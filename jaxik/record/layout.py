"""The record as it is stored: its fields in order, and its bytes."""

import dataclasses
import re
import struct

import numpy as np

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
    ("heightOffsetOnGain", "pelvis.half_life", "gain"),
    ("heightOffsetOffGain", "pelvis.airborne_half_life", "gain"),
    ("forwardUndulationRate", "lean.forward_rate", "lean"),
    ("sideUndulationRate", "lean.side_rate", "lean"),
    ("forwardUndulationRateSlide", "lean.forward_rate_slide", "lean"),
    ("sideUndulationRateSlide", "lean.side_rate_slide", "lean"),
    ("undulationGain", "lean.half_life", "gain"),
    ("undulationGainSlide", "lean.half_life_slide", "gain"),
    ("undulationGainDefaultToSlide", "lean.slide_on_half_life", "gain"),
    ("undulationGainSlideToDefault", "lean.slide_off_half_life", "gain"),
    ("lockedDisableMinAngle", "lock.release_min_angle", "deg"),
    ("lockedDisableMaxAngle", "lock.release_max_angle", "deg"),
    ("lockedDisableDirAngle", "lock.release_cone", "deg"),
    ("nextLockFactorThreshold", "lock.relock_threshold", "1"),
)
FLOAT_NAMES = tuple(name for name, _, _ in FLOATS)
FLAG_NAMES = tuple(name for _, name, _ in FLAGS)
PARAMETERS = frozenset(  # our names of all that the bytes hold, whole vectors without an index
    [ours for _, _, ours in FLAGS] + [ours.partition("[")[0] for _, ours, _ in FLOATS]
)
KNEE_AXES = np.concatenate([np.eye(3), -np.eye(3)])  # by kneeAxisType
KNEE_AXIS_NAMES = ("+X", "+Y", "+Z", "-X", "-Y", "-Z")  # likewise
QUIET_NAN = b"\0\0\xc0\x7f"  # what "nan" reads as


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


def knee_axis(record: Record) -> np.ndarray:
    """The hinge of the knee in knee space, unit (3,)."""
    if record.knee_axis_type >= len(KNEE_AXES):
        known = " ".join(KNEE_AXIS_NAMES)
        raise ValueError(f"kneeAxisType is {record.knee_axis_type}; 0 to 5 are {known}")
    return KNEE_AXES[record.knee_axis_type]


def besides_parameters(record: Record) -> list[str]:
    """What a record holds that is not a parameter: knee axis, padding and tail, in words.

    Padding of zeros and an empty tail are left out.
    """
    axis, padding_bits = record.knee_axis_type, record.flags >> len(FLAGS)
    parts = [f"kneeAxisType {axis} ({dict(enumerate(KNEE_AXIS_NAMES)).get(axis, 'unknown')})"]
    if padding_bits or any(record.padding):
        parts.append(f"padding (bits {padding_bits:#x}, bytes {record.padding.hex()})")
    if record.tail:
        parts.append(f"a tail of {len(record.tail)} bytes")
    return parts


def pack_float(value: float | str) -> bytes:
    """The bytes of the f32 nearest to a number or its text; a ValueError if there is none."""
    if isinstance(value, str) and (bits := re.fullmatch(r"nan\(0x([0-9a-fA-F]{8})\)", value)):
        return bytes.fromhex(bits[1])[::-1]
    number = float(value)
    try:
        return QUIET_NAN if np.isnan(number) else struct.pack("<f", number)
    except OverflowError:
        raise ValueError(f"{value} is beyond a 32-bit float") from None
