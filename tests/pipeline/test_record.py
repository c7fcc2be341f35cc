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
from jaxik.maths import parameter_tree
from jaxik.record import FLAG_NAMES, FLOAT_NAMES, Reading, Record
from reference import sample_poses
from support.clips import to_rig
from support.records import ADULT, packed

LENGTHS = (
    "footPlantedAnkleHeightMS",
    "footRaisedAnkleHeightMS",
    "raycastDistanceUp",
    "raycastDistanceDown",
)

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


def test_nan_payloads_padding_bits_and_tail_round_trip():
    data = bytearray(range(0x80)) + b"\x00tail\xff"
    data[1] = 0b10101_010
    data[4:8] = NAN_WITH_PAYLOAD
    data[8:12] = b"\x01\x00\x80\x7f"  # a signalling NaN
    kept = record.from_bytes(bytes(data))
    assert record.to_bytes(kept) == data
    assert math.isnan(kept.value("originalGroundHeightMS"))
    assert (kept.flags >> 3, kept.padding, kept.tail) == (0b10101, b"\x02\x03", b"\x00tail\xff")


def test_fields_lie_where_the_layout_says():
    data = bytearray(0x80)
    data[0], data[1] = 4, 0b011
    for index, value in enumerate(ADULT.values()):
        struct.pack_into("<f", data, 4 + 4 * index, value)
    read = record.from_bytes(bytes(data))
    assert read.knee_axis_type == 4
    assert [read.flag(name) for name in FLAG_NAMES] == [True, True, False]
    assert tuple(ADULT) == FLOAT_NAMES and len(FLOAT_NAMES) == 31
    for name, value in ADULT.items():
        assert read.value(name) == np.float32(value)


def test_too_few_bytes_are_an_error():
    with pytest.raises(ValueError, match="at least 128 bytes; these are 127"):
        record.from_bytes(bytes(127))


@pytest.mark.parametrize("read", [Record().value, Record().flag])
def test_an_unknown_name_is_an_error_that_lists_the_known_ones(read):
    with pytest.raises(ValueError, match=r"no (float|flag) 'knee'; it has \["):
        read("knee")


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"knee_axis_type": 256}, "knee_axis_type is 256"),
        ({"flags": -1}, "flags is -1"),
        ({"padding": b"\0"}, "padding and floats"),
        ({"floats": (b"\0\0\0\0",) * 30}, "padding and floats"),
    ],
)
def test_a_record_that_cannot_be_stored_is_an_error(wrong, message):
    with pytest.raises(ValueError, match=message):
        Record(**wrong)


def test_the_record_of_an_adult_has_the_default_parameters():
    meant = leaves_of(to_ik(packed()))
    for name, default in leaves_of(jaxik.presets.record(faithful=True)).items():
        # Defaults have seven digits, the record holds a float32.
        np.testing.assert_allclose(meant[name], default, rtol=2e-6, atol=1e-7, err_msg=name)


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
    ik = to_ik(packed(), Reading(tick_hz=60.0))
    assert ik.lock.lock_half_life == 0.05 and np.isinf(ik.lock.max_speed)
    assert ik.lean.tick_hz == ik.pelvis.tick_hz == 60.0


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_float_that_is_not_finite_is_an_error_that_names_it(value):
    with pytest.raises(ValueError, match="undulationGain is .*finite"):
        to_ik(packed(undulationGain=value))


def test_centimetres_are_recognised_with_a_warning():
    centimetres = packed(**{name: 100.0 * ADULT[name] for name in LENGTHS})
    with pytest.warns(UserWarning, match="centimetres") as caught:
        read = leaves_of(to_ik(centimetres))
    assert [str(w.message).split(" = ")[0] for w in caught] == list(LENGTHS)
    for name, expected in leaves_of(to_ik(packed())).items():
        np.testing.assert_allclose(read[name], expected, rtol=1e-6, err_msg=name)


def test_an_explicit_length_unit_is_used_without_a_warning():
    for unit, metres in (("m", 0.16), ("cm", 0.0016)):
        ik = to_ik(packed(), Reading(length_unit=unit))
        assert ik.contact.raised_height == pytest.approx(metres)
    ik = to_ik(packed(raycastDistanceUp=6.0), Reading(length_unit="m"))
    assert ik.probe.ray_up == 6.0
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
    np.testing.assert_allclose([*rates, lean.gain], [0.30, 0.10, -0.80, -0.60, 0.19], rtol=1e-6)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"length_unit": "inch"}, "length_unit is 'inch'; it is one of"),
        ({"knee_convention": "outer"}, "knee_convention is 'outer'"),
        ({"lean_sign": 0}, "lean_sign is 0"),
        ({"tick_hz": 0.0}, "tick_hz is 0.0"),
        ({"tick_hz": math.nan}, "tick_hz is nan"),
    ],
)
def test_an_unknown_reading_is_an_error(wrong, message):
    with pytest.raises(ValueError, match=message):
        Reading(**wrong)


def test_the_knee_axis_follows_its_enum():
    axes = [record.knee_axis(Record(knee_axis_type=kind)) for kind in range(6)]
    np.testing.assert_array_equal(axes, [*np.eye(3), *-np.eye(3)])
    for call in (record.knee_axis, record.to_ik):
        with pytest.raises(ValueError, match="kneeAxisType is 6; 0 to 5"):
            call(Record(knee_axis_type=6))


def test_a_rig_gets_the_knee_axis_and_keeps_the_rest():
    rig = to_rig(sample_poses.make_rig(np.random.default_rng(0)))
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


@pytest.mark.filterwarnings("ignore:.*(centimetres|degrees)")
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
    changes = {"lean.gain": 0.3, "leg.max_knee_angle": 2.8, "lock.enabled": False}
    ik = parameter_tree.replace(jaxik.presets.record(faithful=True), changes)
    meant = to_ik(record.from_ik(ik, Record()))
    for name, expected in leaves_of(ik).items():
        np.testing.assert_allclose(leaves_of(meant)[name], expected, atol=2e-6, err_msg=name)
    assert not parameter_tree.get(meant, "lock.enabled")


def test_a_changed_parameter_changes_its_own_bytes_only():
    kept = packed()
    changes = {"pelvis.limit": 0.25, "pelvis.vertical_only": False}
    rebuilt = record.from_ik(parameter_tree.replace(to_ik(kept), changes), kept)
    pairs = zip(FLOAT_NAMES, kept.floats, rebuilt.floats, strict=True)
    assert [name for name, a, b in pairs if a != b] == ["heightOffsetLimit"]
    assert rebuilt.value("heightOffsetLimit") == 0.25
    assert (rebuilt.flags, rebuilt.tail) == (0b011, kept.tail)


def test_a_record_in_centimetres_stays_in_centimetres():
    kept = packed(**{name: 100.0 * ADULT[name] for name in LENGTHS})
    with pytest.warns(UserWarning, match="centimetres"):
        ik = to_ik(kept)
    rebuilt = record.from_ik(parameter_tree.replace(ik, {"probe.ray_up": 0.6}), kept)
    assert rebuilt.value("raycastDistanceUp") == pytest.approx(60.0)
    assert rebuilt.value("raycastDistanceDown") == pytest.approx(80.0)


def test_lengths_that_would_be_read_in_another_unit_are_not_written():
    ik = parameter_tree.replace(jaxik.presets.record(faithful=True), {"probe.ray_up": 6.0})
    with pytest.raises(ValueError, match='written in m .* set length_unit to "m" or "cm"'):
        record.from_ik(ik, Record())
    written = record.from_ik(ik, Record(), Reading(length_unit="m"))
    assert written.value("raycastDistanceUp") == 6.0


def test_a_parameter_that_differs_between_legs_does_not_fit_the_record():
    ik = jaxik.presets.record(faithful=True)
    same = parameter_tree.replace(ik, {"probe.toe_ls": [[0.01, -0.07, 0.2]] * 2})
    assert record.from_ik(same, Record()).value("footEndLS_X") == np.float32(0.01)
    with pytest.raises(ValueError, match=r"foot.max_pitch is \[0.4, 0.5\].*one value"):
        record.from_ik(parameter_tree.replace(ik, {"foot.max_pitch": [0.5, 0.4]}), Record())
    with pytest.raises(ValueError, match="beyond a 32-bit float"):
        record.from_ik(parameter_tree.replace(ik, {"pelvis.limit": 1e39}), Record())


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("target.rise_half_life", 0.1, "target.rise_half_life = 0.1 s (0 s)"),
        ("lock.max_speed", 0.9, "lock.max_speed = 0.9 m/s (inf m/s)"),
        ("lock.release_distance", math.inf, "lock.release_distance = inf m (0.2 m)"),
        ("target.max_slope", 0.3, "target.max_slope = 0.3 rad (17.19°) (1.047 rad (60°))"),
        ("leg.soften", [0.9, 0.8], "leg.soften = [0.9, 0.8] (0.98)"),
        ("lean.spring", True, "lean.spring = on (off)"),
        ("probe.layers", 0b101, "probe.layers = 0x5 (all)"),
        ("pelvis.tick_hz", 60.0, "pelvis.tick_hz = 60 Hz (30 Hz)"),
    ],
)
def test_a_parameter_without_a_slot_is_named_with_what_a_reader_assumes(name, value, message):
    ik = parameter_tree.replace(jaxik.presets.record(faithful=True), {name: value})
    lost = f"the record cannot hold {message}; its reader takes the values in brackets"
    with pytest.raises(ValueError, match=re.escape(f"{lost}. To leave them out nevertheless")):
        record.from_ik(ik, Record())
    with pytest.warns(UserWarning) as caught:
        written = record.from_ik(ik, Record(), drop=True)
    assert [str(warning.message) for warning in caught] == [lost]
    assert list(record.dropped(ik)) == [name] and record.dropped(to_ik(written)) == {}


def test_exactly_the_parameters_without_a_slot_are_dropped():
    def changed(leaf):
        if leaf.dtype == bool:
            return ~leaf
        return (
            leaf // 2
            if leaf.dtype == jnp.uint32
            else np.where(np.isinf(leaf), 1.0, leaf * 0.8 + 0.11)
        )

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


def test_a_system_of_other_rules_is_no_record():
    with pytest.raises(ValueError, match="contact is a LabelContact; .* there a HeightContact"):
        record.from_ik(jaxik.presets.stride())


def test_records_round_trip_through_csv_byte_for_byte():
    odd = record.from_bytes(bytes([255, 255, 1, 2]) + NAN_WITH_PAYLOAD * 31 + b"\0\xff")
    plain = Record(floats=(b"\0\0\xc0\x7f", b"\0\0\x80\xff", b"\0\0\0\x80") + packed().floats[3:])
    for records in ([packed()], [odd, plain, *finite_records(40)], []):
        assert record.from_csv(record.to_csv(records)) == records


def test_csv_uses_the_records_own_names():
    head, row = record.to_csv([packed()]).splitlines()
    assert head.split(",") == list(record.COLUMNS)
    cells = dict(zip(head.split(","), row.split(","), strict=True))
    assert cells["footPlantedAnkleHeightMS"] == "0.1" and cells["useFootLocking"] == "1"
    assert (cells["pad1"], cells["pad3"], cells["kneeAxisType"]) == ("0000", "", "2")


def test_csv_without_padding_and_in_another_order_is_read():
    columns = [name for name in reversed(record.COLUMNS) if not name.startswith("pad")]
    values = {name: str(value) for name, value in ADULT.items()}
    values |= dict.fromkeys(FLAG_NAMES, "1") | {"kneeAxisType": "2"}
    text = ",".join(columns) + "\n" + ", ".join(values[name] for name in columns) + "\n"
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


@pytest.mark.parametrize("expected", UNREADABLE)
def test_an_unreadable_cell_is_an_error_that_names_row_and_column(expected):
    for name, cells in UNREADABLE[expected].items():
        for cell in cells:
            message = f"row 3, column {name}: {re.escape(repr(cell))} is not {expected}"
            with pytest.raises(ValueError, match=message):
                record.from_csv(with_cell(name, cell))


def test_missing_unknown_or_duplicate_columns_are_an_error():
    head, row = record.to_csv([packed()]).splitlines()
    misspelt = head.replace("undulationGain,", "undulatoinGain,")
    for text, message in (
        (f"{misspelt}\n{row}\n", r"no column \['undulationGain'\]"),
        (f"{head},mass\n{row},80\n", r"unknown columns \['mass'\]; a record has \['kneeAxis"),
        (f"{head},pad1\n{row},0000\n", r"column \['pad1'\] more than once"),
        ("", "no column"),
    ):
        with pytest.raises(ValueError, match=message):
            record.from_csv(text)
    for cells in (row + ",1", row.rsplit(",", 2)[0]):
        with pytest.raises(ValueError, match="row 2 has not the 38 cells of the header"):
            record.from_csv(f"{head}\n{cells}\n")
