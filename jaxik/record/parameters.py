"""What a record means: the parameters of the faithful record preset, in our names and units."""

import dataclasses
import math
import warnings

import jax.numpy as jnp
import numpy as np

from jaxik import presets
from jaxik.maths import parameter_tree
from jaxik.maths.smoothing import LN2
from jaxik.pipeline import FootIK
from jaxik.world.skeleton import Rig

from .layout import FLAGS, FLOATS, PARAMETERS, Record, besides_parameters, knee_axis, pack_float


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
        tick_hz: the game's rate. A gain is the part of a gap that closes in one of its ticks, and
            so stands for a half-life.
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


def to_ik(record: Record, reading: Reading | None = None) -> FootIK:
    """The faithful record preset with a record's parameters; those it lacks keep their defaults.

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
    return parameter_tree.replace(
        presets.record(faithful=True), values | {"probe.toe_ls": toe} | switches
    )


def from_ik(
    ik: FootIK,
    base: Record | None = None,
    reading: Reading | None = None,
    *,
    drop: bool = False,
) -> Record:
    """The record with a system's parameters.

    Warns, without a base, of what is written for knee axis, padding and tail.

    Args:
        ik: a system with the rules of `presets.record(faithful=True)`.
        base: where knee axis, padding and tail come from. A float whose value is the same in `base`
            and `ik` keeps its bytes.
        reading: units and signs to write. With `length_unit` "auto" lengths get the unit of `base`,
            or metres.
        drop: whether to leave out, with a warning, what the record cannot hold (`dropped`).

    Raises:
        ValueError: if the system has other rules, or values that the record cannot hold and that
            are not to be left out; if a parameter differs between legs, does not fit a 32-bit
            float, or would be read back in another unit.
    """
    reading = reading or Reading()
    template = base or Record()
    if lost := dropped(ik, reading):
        listed = ", ".join(f"{name} = {ours} ({theirs})" for name, (ours, theirs) in lost.items())
        message = f"the record cannot hold {listed}; its reader takes the values in brackets"
        if not drop:
            raise ValueError(
                f"{message}. To leave them out nevertheless, pass drop=True, or --drop to `jaxik "
                "record to-bytes`; `jaxik fit --record-only` fits only what the record holds"
            )
        warnings.warn(message, stacklevel=2)
    if base is None:
        (knee,) = besides_parameters(template)
        warnings.warn(
            f"parameters do not tell the knee's axis: {knee}, zero padding and no tail are "
            "written, as no base record was given",
            stacklevel=2,
        )
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
        stored = pack_float(_to_stored(value, unit, reading))
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


def dropped(ik: FootIK, reading: Reading | None = None) -> dict[str, tuple[str, str]]:
    """The parameters and switches that bytes cannot hold and whose reader would assume otherwise.

    Returns:
        By dotted name the value in `ik` and the one that `to_ik` gives, both with their units.

    Raises:
        ValueError: if the system has other rules than those of `presets.record(faithful=True)`.
    """
    assumed = to_ik(Record(), reading)
    for stage, rule in vars(assumed).items():
        if type(other := getattr(ik, stage)) is not type(rule):
            raise ValueError(
                f"{stage} is a {type(other).__name__}; a record holds parameters of a system with "
                f"the record's rules, there a {type(rule).__name__}"
            )
    return {
        name: (parameter_tree.shown(ik, name), parameter_tree.shown(assumed, name))
        for name in parameter_tree.docs(ik)
        if name not in PARAMETERS
        and not np.allclose(
            parameter_tree.get(ik, name), parameter_tree.get(assumed, name), rtol=1e-6, atol=0.0
        )
    }


def with_knee_axis(rig: Rig, record: Record) -> Rig:
    """The rig with the record's knee axis, for a game skeleton.

    Not for rigs that were measured from a captured clip: these have their own axes.
    """
    axis = jnp.asarray(knee_axis(record), rig.knee_axis_ls.dtype)
    return dataclasses.replace(rig, knee_axis_ls=jnp.broadcast_to(axis, rig.knee_axis_ls.shape))


def _fields(reading: Reading) -> list[tuple[str, str, str]]:
    """`FLOATS` for a reading: the largest flexion is the smallest interior angle."""
    if reading.knee_convention == "interior":
        return list(FLOATS)
    other = {"leg.max_knee_angle": "leg.min_knee_angle", "leg.min_knee_angle": "leg.max_knee_angle"}
    return [(name, other.get(ours, ours), unit) for name, ours, unit in FLOATS]


def half_life_of_gain(gain: float, tick_hz: float) -> float:
    """Half-life, s, of a gain per tick: infinite for a gain of 0 or less, 0 for 1 or more."""
    if gain <= 0.0:
        return math.inf
    return -LN2 / (tick_hz * math.log1p(-gain)) if gain < 1.0 else 0.0


def gain_of_half_life(half_life: float, tick_hz: float) -> float:
    """Gain per tick of 1/`tick_hz` s of a half-life, s: 1 for a half-life of 0 or less."""
    return -math.expm1(-LN2 / (tick_hz * half_life)) if half_life > 0.0 else 1.0


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
    """A stored number in our units: metres, radians, seconds."""
    if unit == "length":
        if reading.length_unit == "cm":
            return value / 100.0
        if reading.length_unit == "auto" and _in_centimetres(record):
            warnings.warn(f"{name} = {value} is read as centimetres", stacklevel=3)
            return value / 100.0
    if unit == "cosine":
        if abs(value) > 1.0:
            warnings.warn(f"{name} = {value} is not a cosine; it is read as degrees", stacklevel=3)
            angle = np.radians(value)
        else:
            angle = np.arccos(value)
        return float(angle if reading.knee_convention == "interior" else np.pi - angle)
    if unit == "gain":
        if not 0.0 <= value <= 1.0:
            warnings.warn(
                f"{name} = {value} is not a gain, 0 to 1; the nearest is read", stacklevel=3
            )
        return half_life_of_gain(value, reading.tick_hz)
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
    if unit == "gain":
        return gain_of_half_life(value, reading.tick_hz)
    if unit == "deg":
        return float(np.degrees(value))
    if unit == "lean":
        return reading.lean_sign * value
    return value
