"""The parameter record: its bytes, CSV text, and the parameters they stand for."""

import itertools
import math
import re
import struct
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import jaxik
from jaxik import record
from jaxik.maths import parameter_tree, smoothing
from jaxik.record import FLAG_NAMES, FLOAT_NAMES, Reading, Record
from support.clips import make_rig, to_rig
from support.records import ADULT, packed

LENGTHS = (
    "footPlantedAnkleHeightMS",
    "footRaisedAnkleHeightMS",
    "raycastDistanceUp",
    "raycastDistanceDown",
)

HALF_LIVES = {name: ours for name, ours, unit in record.FLOATS if unit == "gain"}
to_ik: Any = record.to_ik  # whose rules have more than the abstract ones
NAN_WITH_PAYLOAD = b"\x34\x12\xa0\xff"


def leaves_of(ik: jaxik.FootIK) -> dict[str, np.ndarray]:
    return {
        name: np.asarray(parameter_tree.get(ik, name)) for name in parameter_tree.declarations(ik)
    }


@settings(max_examples=200, deadline=None)
@given(st.binary(min_size=record.SIZE, max_size=record.SIZE + 40))
def test_any_bytes_round_trip(data):
    assert record.to_bytes(record.from_bytes(data)) == data


def test_fields_lie_where_the_layout_says():
    data = bytearray(range(0x80)) + b"\x00tail\xff"
    data[0], data[1] = 4, 0b10101_011
    for index, value in enumerate(ADULT.values()):
        struct.pack_into("<f", data, 4 + 4 * index, value)
    data[4:8] = NAN_WITH_PAYLOAD
    read = record.from_bytes(bytes(data))
    assert read.knee_axis_type == 4
    assert [read.flag(name) for name in FLAG_NAMES] == [True, True, False]
    assert (read.flags >> 3, read.padding, read.tail) == (0b10101, b"\x02\x03", b"\x00tail\xff")
    assert tuple(ADULT) == FLOAT_NAMES and len(FLOAT_NAMES) == 31
    first, *others = ADULT
    assert math.isnan(read.value(first))
    assert [read.value(name) for name in others] == [np.float32(ADULT[name]) for name in others]


def replaced(changes: dict[str, Any]) -> jaxik.FootIK:
    """The faithful system with other values."""
    return parameter_tree.replace(jaxik.presets.record(faithful=True), changes)


def test_what_is_no_record_or_fits_in_none_is_refused():
    for call, message in (
        (lambda: record.from_bytes(bytes(127)), "at least 128 bytes; these are 127"),
        (lambda: Record().value("knee"), r"no float 'knee'; it has \["),
        (lambda: Record().flag("knee"), r"no flag 'knee'; it has \["),
        (lambda: Record(knee_axis_type=256), "knee_axis_type is 256"),
        (lambda: Record(flags=-1), "flags is -1"),
        (lambda: Record(padding=b"\0"), "padding and floats"),
        (lambda: Record(floats=(bytes(4),) * 30), "padding and floats"),
        (lambda: Reading(length_unit="inch"), "length_unit is 'inch'; it is one of"),
        (lambda: Reading(knee_convention="outer"), "knee_convention is 'outer'"),
        (lambda: Reading(lean_sign=0), "lean_sign is 0"),
        (lambda: Reading(tick_hz=0.0), "tick_hz is 0.0"),
        (lambda: Reading(tick_hz=math.nan), "tick_hz is nan"),
        (lambda: to_ik(packed(undulationGain=math.nan)), "undulationGain is .*finite"),
        (lambda: to_ik(packed(undulationGain=-math.inf)), "undulationGain is .*finite"),
        (lambda: to_ik(Record(knee_axis_type=6)), "kneeAxisType is 6; 0 to 5"),
        (lambda: record.knee_axis(Record(knee_axis_type=6)), "kneeAxisType is 6; 0 to 5"),
        (lambda: record.from_ik(jaxik.presets.stride()), "LabelContact; .* there a HeightContact"),
        (
            lambda: record.from_ik(replaced({"foot.max_pitch": [0.5, 0.4]}), Record()),
            r"foot.max_pitch is \[0.4, 0.5\].*one value",
        ),
        (
            lambda: record.from_ik(replaced({"pelvis.limit": 1e39}), Record()),
            "beyond a 32-bit float",
        ),
        (  # it would be read in another unit
            lambda: record.from_ik(replaced({"probe.ray_up": 6.0}), Record()),
            'written in m .* set length_unit to "m" or "cm"',
        ),
    ):
        with pytest.raises(ValueError, match=message):
            call()


def test_the_record_of_an_adult_has_the_default_parameters():
    meant = leaves_of(to_ik(packed()))
    for name, default in leaves_of(jaxik.presets.record(faithful=True)).items():
        # Defaults have seven digits, half-lives four; the record holds a float32.
        digits = 5e-4 if name in HALF_LIVES.values() else 2e-6
        np.testing.assert_allclose(meant[name], default, rtol=digits, atol=1e-7, err_msg=name)


def test_each_float_and_each_flag_sets_its_own_parameter():
    before = leaves_of(to_ik(packed()))
    for name, ours, _ in record.FLOATS:
        after = leaves_of(to_ik(packed(**{name: ADULT[name] * 0.9 + 0.001})))
        changed = [key for key in before if not np.array_equal(before[key], after[key])]
        assert changed == [ours.partition("[")[0]], name
    switches = ("lock.enabled", "probe.use_toe", "pelvis.vertical_only")
    for bit, name in enumerate(FLAG_NAMES):
        other = Record(flags=0b111 & ~(1 << bit), floats=packed().floats)
        assert not other.flag(name) and packed().flag(name)
        ik = to_ik(other)
        assert [bool(parameter_tree.get(ik, x)) for x in switches] == [i != bit for i in range(3)]


def test_parameters_that_the_record_lacks_keep_their_defaults():
    ik = to_ik(packed())
    assert ik.lock.lock_half_life == 0.05 and np.isinf(ik.lock.max_speed)


def test_centimetres_are_recognised_with_a_warning_and_kept():
    kept = packed(**{name: 100.0 * ADULT[name] for name in LENGTHS})
    with pytest.warns(UserWarning, match="centimetres") as caught:
        ik = to_ik(kept)
    assert [str(w.message).split(" = ")[0] for w in caught] == list(LENGTHS)
    for name, expected in leaves_of(to_ik(packed())).items():
        np.testing.assert_allclose(leaves_of(ik)[name], expected, rtol=1e-6, err_msg=name)
    rebuilt = record.from_ik(parameter_tree.replace(ik, {"probe.ray_up": 0.6}), kept)
    assert rebuilt.value("raycastDistanceUp") == pytest.approx(60.0)
    assert rebuilt.value("raycastDistanceDown") == pytest.approx(80.0)


def test_an_explicit_length_unit_is_used_without_a_warning():
    for unit, metres in (("m", 0.16), ("cm", 0.0016)):
        ik = to_ik(packed(), Reading(length_unit=unit))
        assert ik.contact.raised_height == pytest.approx(metres)
    in_metres = Reading(length_unit="m")
    ik = to_ik(packed(raycastDistanceUp=6.0), in_metres)
    assert ik.probe.ray_up == 6.0
    assert record.from_ik(ik, Record(), in_metres).value("raycastDistanceUp") == 6.0
    assert ik.target.max_ankle_height == pytest.approx(0.55), "other heights are always in metres"


def test_a_cosine_out_of_range_is_degrees_with_a_warning():
    with pytest.warns(UserWarning, match="cosineMaxKneeAngle = 170.0 .*degrees"):
        ik = to_ik(packed(cosineMaxKneeAngle=170.0))
    assert ik.leg.max_knee_angle == pytest.approx(math.radians(170.0))


def test_flexion_is_measured_from_the_straight_leg():
    # At least 8 and at most 140 degrees bent: the interior angle lies between 40 and 172.
    most, least = (math.cos(math.radians(angle)) for angle in (140, 8))
    bent = packed(cosineMaxKneeAngle=most, cosineMinKneeAngle=least)
    flexion = Reading(knee_convention="flexion")
    ik = to_ik(bent, flexion)
    limits = [ik.leg.min_knee_angle, ik.leg.max_knee_angle]
    np.testing.assert_allclose(np.degrees(limits), [40, 172], rtol=1e-6)
    assert record.from_ik(ik, bent) != bent
    assert record.from_ik(ik, bent, flexion) == bent


def test_the_sign_of_the_lean_can_be_reversed():
    lean = to_ik(packed(), Reading(lean_sign=-1)).lean
    rates = [lean.forward_rate, lean.side_rate, lean.forward_rate_slide, lean.side_rate_slide]
    np.testing.assert_allclose(rates, [0.30, 0.10, -0.80, -0.60], rtol=1e-6)


def test_the_knee_axis_follows_its_enum():
    axes = [record.knee_axis(Record(knee_axis_type=kind)) for kind in range(6)]
    np.testing.assert_array_equal(axes, [*np.eye(3), *-np.eye(3)])


def test_a_rig_gets_the_knee_axis_and_keeps_the_rest():
    rig = to_rig(make_rig())
    turned = record.with_knee_axis(rig, Record(knee_axis_type=3))
    np.testing.assert_array_equal(turned.knee_axis_ls, [[-1, 0, 0]] * 2)
    assert turned.knee_axis_ls.dtype == rig.knee_axis_ls.dtype
    np.testing.assert_array_equal(turned.ankle_from_foot, rig.ankle_from_foot)


def finite_records(count: int, seed: int = 0) -> list[Record]:
    """Random bits in every field; floats finite, of any size."""
    rng = np.random.default_rng(seed)
    records = []
    for _ in range(count):
        bits = rng.integers(0, 256, (31, 4), np.uint8)
        exponents = rng.integers(90, 140, 31)  # 2^-37 to 2^12: distinct in all units
        bits[:, 3] = (bits[:, 3] & 0x80) | (exponents >> 1)
        bits[:, 2] = (bits[:, 2] & 0x7F) | ((exponents & 1) << 7)
        head = int(rng.integers(6)), int(rng.integers(256)), rng.bytes(2)
        records.append(Record(*head, tuple(row.tobytes() for row in bits), rng.bytes(7)))
    return records


@pytest.mark.parametrize("tick_hz", [30.0, 60.0])
def test_a_gain_closes_its_part_of_the_gap_in_each_tick_of_the_game(tick_hz):
    gains = dict(zip(HALF_LIVES, (0.0, 1e-4, 0.2, 0.5, 0.95, 1.0), strict=True))
    reading = Reading(tick_hz=tick_hz)
    ik = to_ik(packed(**gains), reading)
    for name, gain in gains.items():
        half_life = parameter_tree.get(ik, HALF_LIVES[name])
        fraction = smoothing.fraction_of_half_life(half_life, jnp.asarray(1.0 / tick_hz))
        np.testing.assert_allclose(fraction, np.float32(gain), rtol=1e-6, err_msg=name)
    written = record.from_ik(ik, Record(), reading)
    np.testing.assert_allclose(
        [written.value(name) for name in gains], [*gains.values()], rtol=1e-6
    )
    # At another rate, the same motion takes other gains.
    other = record.from_ik(ik, Record(), Reading(tick_hz=tick_hz / 2))
    twice = [1 - (1 - gain) ** 2 for gain in gains.values()]
    np.testing.assert_allclose([other.value(name) for name in gains], twice, rtol=1e-6)


def test_a_number_that_is_no_gain_is_read_as_the_nearest_with_a_warning():
    for stored, half_life in ((-0.1, math.inf), (1.5, 0.0)):
        with pytest.warns(UserWarning, match=f"undulationGain = {stored}.* is not a gain, 0 to 1"):
            assert to_ik(packed(undulationGain=stored)).lean.half_life == half_life


@pytest.mark.filterwarnings("ignore:.*(centimetres|degrees|not a gain)")
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("length_unit", ["auto", "m", "cm"])
def test_a_record_round_trips_through_parameters(length_unit, dtype):
    for knee_convention, lean_sign in itertools.product(("interior", "flexion"), (1, -1)):
        reading = Reading(length_unit, knee_convention, lean_sign)
        for kept in [packed(), *finite_records(5)]:
            ik = to_ik(kept, reading)
            ik = jax.tree.map(lambda x: x if x.dtype == bool else x.astype(dtype), ik)
            assert record.to_bytes(record.from_ik(ik, kept, reading)) == record.to_bytes(kept)


def test_parameters_round_trip_through_a_record():
    changes = {"lean.half_life": 0.3, "leg.max_knee_angle": 2.8, "lock.enabled": False}
    ik = replaced(changes | {"probe.toe_ls": [[0.01, -0.07, 0.2]] * 2})  # the same for both legs
    meant = leaves_of(to_ik(record.from_ik(ik, Record())))
    for name, leaf in leaves_of(ik).items():
        expected = leaf[0] if name == "probe.toe_ls" else leaf
        np.testing.assert_allclose(meant[name], expected, atol=2e-6, err_msg=name)


def test_a_changed_parameter_changes_its_own_bytes_only():
    kept = packed()
    changes = {"pelvis.limit": 0.25, "pelvis.vertical_only": False}
    rebuilt = record.from_ik(parameter_tree.replace(to_ik(kept), changes), kept)
    pairs = zip(FLOAT_NAMES, kept.floats, rebuilt.floats, strict=True)
    assert [name for name, a, b in pairs if a != b] == ["heightOffsetLimit"]
    assert rebuilt.value("heightOffsetLimit") == 0.25
    assert (rebuilt.flags, rebuilt.tail) == (0b011, kept.tail)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("target.rise_half_life", 0.1, "target.rise_half_life = 0.1 s (0 s)"),
        ("lock.max_speed", 0.9, "lock.max_speed = 0.9 m/s (inf m/s)"),
        ("lock.release_distance", math.inf, "lock.release_distance = inf m (0.2 m)"),
        ("target.max_slope", 0.3, "target.max_slope = 0.3 rad (17.19°) (1.047 rad (60°))"),
        ("leg.soften", [0.9, 0.8], "leg.soften = [0.9, 0.8] (1)"),
        ("lean.spring", True, "lean.spring = on (off)"),
        ("probe.layers", 0b101, "probe.layers = 0x5 (all)"),
    ],
)
def test_a_parameter_without_a_slot_is_named_with_what_a_reader_assumes(name, value, message):
    ik = replaced({name: value})
    lost = f"the record cannot hold {message}; its reader takes the values in brackets"
    with pytest.raises(ValueError, match=re.escape(f"{lost}. To leave them out nevertheless")):
        record.from_ik(ik, Record())
    with pytest.warns(UserWarning) as caught:
        written = record.from_ik(ik, Record(), drop=True)
    assert [(str(said.message), said.filename) for said in caught] == [(lost, __file__)]
    assert list(record.dropped(ik)) == [name] and record.dropped(to_ik(written)) == {}


def test_exactly_the_parameters_without_a_slot_are_dropped():
    def changed(leaf):
        if leaf.dtype == bool:
            return ~leaf
        if leaf.dtype == jnp.uint32:
            return leaf // 2
        return np.where(np.isinf(leaf), 1.0, leaf * 0.8 + 0.11)

    ik = jaxik.presets.record(faithful=True)
    leaves = {slot.name: slot.value for slot in parameter_tree.slots(ik)}
    slots = {ours for _, _, ours in record.FLAGS}
    slots |= {ours.partition("[")[0] for _, ours, _ in record.FLOATS}
    assert slots == record.PARAMETERS
    other = {name: changed(leaf) for name, leaf in leaves.items()}
    ik, dropped = parameter_tree.replace(ik, other), set(leaves) - slots
    assert set(record.dropped(ik)) == dropped
    for name, is_on in parameter_tree.options(ik).items():
        ik, dropped = parameter_tree.with_option(ik, name, not is_on), dropped | {name}
        assert set(record.dropped(ik)) == dropped


def test_a_record_without_a_base_says_what_it_takes_for_the_knee():
    with pytest.warns(UserWarning, match=r"2 \(\+Z\), zero padding and no tail") as caught:
        assert record.from_ik(jaxik.presets.record(faithful=True)).knee_axis_type == 2
    assert len(caught) == 1


def test_records_round_trip_through_csv_byte_for_byte():
    odd = record.from_bytes(bytes([255, 255, 1, 2]) + NAN_WITH_PAYLOAD * 31 + b"\0\xff")
    plain = Record(floats=(b"\0\0\xc0\x7f", b"\0\0\x80\xff", b"\0\0\0\x80") + packed().floats[3:])
    for records in ([packed()], [odd, plain, *finite_records(40)], []):
        assert record.from_csv(record.to_csv(records)) == records


def test_csv_uses_the_records_own_names_in_any_order_with_or_without_padding():
    head, row = record.to_csv([packed()]).splitlines()
    assert head.split(",") == list(record.COLUMNS)
    cells = dict(zip(head.split(","), row.split(","), strict=True))
    assert cells["footPlantedAnkleHeightMS"] == "0.1" and cells["useFootLocking"] == "1"
    assert (cells["pad1"], cells["pad3"], cells["kneeAxisType"]) == ("0000", "", "2")
    columns = [name for name in reversed(record.COLUMNS) if not name.startswith("pad")]
    text = ",".join(columns) + "\n" + ", ".join(cells[name] for name in columns) + "\n"
    assert record.from_csv(text) == [packed()]


def with_cell(name: str, cell: str) -> str:
    """Two rows, the second with one cell replaced."""
    head, row = record.to_csv([packed()]).splitlines()
    cells = row.split(",")
    cells[head.split(",").index(name)] = cell
    return "\n".join([head, row, ",".join(cells), ""])


UNREADABLE = {
    "a 32-bit number": {"heightOffsetLimit": ["wide", "", "1e39", "nan(0x12)"]},
    "a whole number from 0 to 255": {"kneeAxisType": ["256", "-1", "2.5"]},
    "a whole number from 0 to 31": {"padflag": ["32"]},
    "0 or 1": {"useFootEndRay": ["2", "yes"]},
    "bytes in hexadecimal": {"pad1": ["00zz"], "pad3": ["0"]},
    "two bytes": {"pad1": ["00", "000000"]},
}


def test_an_unreadable_cell_is_an_error_that_names_row_and_column():
    for expected, columns in UNREADABLE.items():
        for name, cell in ((name, cell) for name, cells in columns.items() for cell in cells):
            message = f"row 3, column {name}: {re.escape(repr(cell))} is not {expected}"
            with pytest.raises(ValueError, match=message):
                record.from_csv(with_cell(name, cell))


def test_missing_unknown_or_duplicate_columns_are_an_error():
    head, row = record.to_csv([packed()]).splitlines()
    misspelt = head.replace("undulationGain,", "undulatoinGain,")
    for header, cells, message in (
        (misspelt, row, r"no column \['undulationGain'\]"),
        (f"{head},mass", f"{row},80", r"unknown columns \['mass'\]; a record has \['kneeAxis"),
        (f"{head},pad1", f"{row},0000", r"column \['pad1'\] more than once"),
        ("", "", "no column"),
        (head, f"{row},1", "row 2 has not the 38 cells of the header"),
        (head, row.rsplit(",", 2)[0], "row 2 has not the 38 cells of the header"),
    ):
        with pytest.raises(ValueError, match=message):
            record.from_csv(f"{header}\n{cells}\n".lstrip())
