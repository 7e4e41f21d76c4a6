"""The signal table against the DBC: errors with file, key and limit."""

import math

import cantools
import pytest
from canedge_bridge.signals import load_dbc, load_table
from st_core.errors import ConfigurationError


def test_leaf_table_and_dbc_agree(dbc_file, signals_file):
    table = load_table(dbc_file, signals_file)
    assert table.absent_messages == ()
    assert {m.name: m.dbc.frame_id for m in table.messages.values()} == {
        "Leaf_Steering": 0x002, "Leaf_WheelSpeedFront": 0x284, "Leaf_WheelSpeedRear": 0x285, "RT_DateTime": 0x600,
        "RT_MilliTime": 0x630, "RT_VelocityLevel": 0x604, "RT_HeadingPitchRoll": 0x607, "RT_RateVehicle": 0x608,
        "RT_IsoOrientation": 0x633, "RT_IsoVsVelocity": 0x634, "RT_IsoVsAngularVelocity": 0x636}
    assert [m.name for m in table.messages.values() if m.is_needed] == ["Leaf_Steering"]


def set_key(path, value):
    """A change of the table that sets one key, or deletes it if the value is None."""

    def change(messages):
        *parents, last = path.split("/")
        entry = messages
        for key in parents:
            entry = entry[key]
        if value is None:
            del entry[last]
        else:
            entry[last] = value

    return change


WHEEL = "Leaf_Steering/signals/SteeringWheelAngle"


@pytest.mark.parametrize(("change", "message"), [
    (set_key("Leaf_Steering/time_out", 1), "messages.Leaf_Steering.time_out: unknown key; known: needed, period"),
    (set_key("Leaf_Steering/needed", None), "messages.Leaf_Steering.needed: missing"),
    (set_key("Leaf_Steering/needed", "yes please"), "messages.Leaf_Steering.needed: 'yes please' is not true or false"),
    (set_key("Leaf_Steering/timeout", {"value": 0, "unit": "s"}), "timeout.value: 0 is outside 0.001 to 600"),
    (set_key("Leaf_Steering/timeout", {"value": 100, "unit": "ms"}), "timeout.unit: 'ms' is not one of s"),
    (set_key("Leaf_Steering/timeout", {"value": 0.1}), "timeout.unit: missing"),
    (set_key("Leaf_Steering/timeout", {"value": math.nan, "unit": "s"}), "timeout.value: nan is not a number"),
    (set_key("Leaf_Steering/checksum/rule", "crc8"), "checksum.rule: 'crc8' is not one of xor_nibble, sum8_id"),
    (set_key("Leaf_Steering/checksum/rule", "sum8_id"), "checksum.rule: needs 8 bits, but SteeringXorNibble has 4"),
    (set_key("Leaf_Steering/checksum/check", "refuse"), "checksum.check: 'refuse' is not one of off, warn, drop"),
    (set_key("Leaf_Steering/counter/signal", "SteeringWheelAngle"), "cannot be a counter"),
    (set_key("Leaf_Steering/fill", {"SteeringConst07": 256}), "fill.SteeringConst07: 256 is outside 0 to 255"),
    (set_key("Leaf_Steering/fill", {"SteeringConst07": 1.5}), "fill.SteeringConst07: 1.5 is not a whole number"),
    (set_key(WHEEL + "/name", "wheel_angle"),
     "SteeringWheelAngle.name: 'wheel_angle' is not one of steering_wheel_angle"),
    (set_key(WHEEL + "/unit", None), "SteeringWheelAngle.unit: missing"),
    (set_key(WHEEL + "/unit", "rad"), "SteeringWheelAngle.unit: 'rad', but"),
    (set_key(WHEEL + "/name", "vehicle_speed"), "unit: 'deg' is not a unit of speed"),
    (set_key(WHEEL + "/sign", 2), "SteeringWheelAngle.sign: 2 is not one of 1, -1"),
    (set_key(WHEEL + "/scale", 1000), "SteeringWheelAngle.scale: 1000 is outside 0.01 to 100"),
    (set_key(WHEEL + "/range", [900, -900]), "SteeringWheelAngle.range: 900 is not below -900"),
    (set_key(WHEEL + "/range", 900), "SteeringWheelAngle.range: expected [minimum, maximum]"),
    (set_key("Leaf_Steering/signals/Wheel", {}), "Leaf_Steering has no signal Wheel"),
    (set_key("Leaf_Steering/samples", [{"data": "1D00", "signal": "SteeringWheelAngle", "value": 0, "unit": "deg"}]),
     "has 2 bytes, but the DBC gives 5"),
    (set_key("Leaf_Steering/samples", [{"data": "xyz", "signal": "SteeringWheelAngle", "value": 0, "unit": "deg"}]),
     "samples[0].data: not hexadecimal bytes"),
    (set_key("RT_MilliTime/signals/UtcOffset", None), "GPS time needs all of gps_time, gps_utc_offset"),
    (set_key("Leaf_Brake", {"needed": True}), "has no message Leaf_Brake"),
    (set_key("Leaf_Steering", []), "messages.Leaf_Steering: expected a mapping with string keys"),
])
def test_invalid_table_is_rejected_in_one_line(change, message, dbc_file, edit_table):
    path = edit_table(change)
    with pytest.raises(ConfigurationError) as error:
        load_table(dbc_file, path)
    text = str(error.value)
    assert message in text and str(path) in text and "\n" not in text


def test_check_can_be_off_without_quotes(dbc_file, edit_table):
    """YAML reads off as false."""
    path = edit_table(set_key("Leaf_Steering/checksum/check", False))
    assert load_table(dbc_file, path).messages["Leaf_Steering"].checksum.mode == "off"


ANGLE = 'SG_ SteeringWheelAngle : 0|16@1- (-0.1,0) [-3276.7|3276.8] "deg"'


@pytest.mark.parametrize(("layout", "message"), [
    # High byte first and unsigned, as in a public DBC of the car.
    ('SG_ SteeringWheelAngle : 7|16@0+ (0.1,0) [0|6553.5] "deg"', "can only decode to 0 .. 6553.5 deg"),
    ('SG_ SteeringWheelAngle : 0|16@1+ (0.1,0) [0|6553.5] "deg"', "16 bits, low byte first, unsigned"),
    ('SG_ SteeringWheelAngle : 0|8@1- (-0.1,0) [-12.8|12.7] "deg"', "can only decode to -12.7 .. 12.8 deg"),
    # Signed and wide enough: only the recorded frame reveals the error.
    ('SG_ SteeringWheelAngle : 7|16@0- (-0.1,0) [-3276.7|3276.8] "deg"',
     "1D 00 00 07 B0 of Leaf_Steering incorrectly: -742.4 deg"),
    ('SG_ SteeringWheelAngle : 0|16@1- (-0.2,0) [-3276.7|3276.8] "deg"', "-5.8 deg instead of -2.9"),
])
def test_dbc_that_decodes_the_steering_incorrectly_is_rejected(layout, message, edit_dbc, signals_file):
    path = edit_dbc(ANGLE, layout)
    with pytest.raises(ConfigurationError, match="decodes") as error:
        load_table(path, signals_file)
    assert message in str(error.value) and str(path) in str(error.value)


def test_steering_sensor_of_opposite_sign_is_accepted(edit_dbc, signals_file):
    """The parameter steering_sign corrects it."""
    path = edit_dbc(ANGLE, ANGLE.replace("-0.1", "0.1"))
    assert "Leaf_Steering" in load_table(path, signals_file).messages


def test_dbc_without_the_needed_message_is_rejected(edit_dbc, signals_file):
    with pytest.raises(ConfigurationError, match=r"has no message Leaf_Steering, which .* marks as needed"):
        load_table(edit_dbc("BO_ 2 Leaf_Steering:", "BO_ 2 Something_Else:"), signals_file)
    with pytest.raises(ConfigurationError, match=r"marks as needed, did you mean leaf_steering\?"):
        load_table(edit_dbc("BO_ 2 Leaf_Steering:", "BO_ 2 leaf_steering:"), signals_file)


@pytest.mark.parametrize("unit", ["mrad", "%"])
def test_unit_that_differs_from_the_dbc_is_rejected(edit_dbc, signals_file, unit):
    with pytest.raises(ConfigurationError, match=rf"SteeringWheelAngle.unit: 'deg', but .* gives '{unit}'"):
        load_table(edit_dbc(ANGLE, ANGLE.replace('"deg"', f'"{unit}"')), signals_file)


def test_dbc_without_the_needed_signal_is_rejected(edit_dbc, signals_file):
    with pytest.raises(ConfigurationError, match="Leaf_Steering has no signal SteeringWheelAngle"):
        load_table(edit_dbc("SG_ SteeringWheelAngle :", "SG_ Wheel :"), signals_file)


def test_dbc_without_an_optional_message_is_accepted(edit_dbc, signals_file):
    table = load_table(edit_dbc("BO_ 1584 RT_MilliTime:", "BO_ 1584 Other:"), signals_file)
    assert table.absent_messages == ("RT_MilliTime",)


def test_needed_messages_can_be_replaced(dbc_file, signals_file):
    table = load_table(dbc_file, signals_file, ["RT_VelocityLevel"])
    assert [m.name for m in table.messages.values() if m.is_needed] == ["RT_VelocityLevel"]
    with pytest.raises(ConfigurationError, match="needed message Unknown is not in the table"):
        load_table(dbc_file, signals_file, ["Unknown"])


@pytest.mark.parametrize("text", ["", "not a dbc at all", "BO_ 2 A: 8 X\n SG_ S : 0|16@1- (1", "\0\1\2\3"])
def test_file_that_is_not_a_dbc_is_rejected(text, tmp_path, signals_file):
    path = tmp_path / "invalid.dbc"
    path.write_text(text)
    with pytest.raises(ConfigurationError) as error:
        load_table(path, signals_file)
    assert str(path) in str(error.value) and "\n" not in str(error.value)


def test_overlapping_signals_are_rejected(edit_dbc, signals_file):
    with pytest.raises(ConfigurationError, match="are overlapping in message Leaf_Steering"):
        load_table(edit_dbc("SteeringWheelRateRaw : 16|8", "SteeringWheelRateRaw : 8|8"), signals_file)


def test_missing_files_are_rejected(dbc_file, signals_file, tmp_path):
    with pytest.raises(ConfigurationError, match=r"missing\.dbc: cannot be read: No such file"):
        load_table(tmp_path / "missing.dbc", signals_file)
    with pytest.raises(ConfigurationError, match=r"missing\.yaml: cannot be read: No such file"):
        load_table(dbc_file, tmp_path / "missing.yaml")


@pytest.mark.parametrize("text", ["messages: [", "[]", "messages: 3", "", "message: {}"])
def test_file_that_is_not_a_table_is_rejected(text, dbc_file, tmp_path):
    path = tmp_path / "invalid.yaml"
    path.write_text(text)
    with pytest.raises(ConfigurationError) as error:
        load_table(dbc_file, path)
    assert str(path) in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize("kind", ["kcd", "sym"])
def test_database_of_another_format_gives_the_same_signals(kind, dbc_file, signals_file, tmp_path):
    file = tmp_path / f"car.{kind.upper()}"
    file.write_text(getattr(cantools.database.load_file(dbc_file), f"as_{kind}_string")())
    data = bytes.fromhex("1D 00 00 07 B0")
    expected, found = (load_table(path, signals_file).messages["Leaf_Steering"] for path in (dbc_file, file))
    assert found.to_si(data) == pytest.approx(expected.to_si(data)) and found.key == expected.key
    file.write_text("BU_: X")
    with pytest.raises(ConfigurationError, match=rf"car\.{kind.upper()}: is not a valid {kind.upper()}: "):
        load_table(file, signals_file)


@pytest.mark.parametrize("extension", [".dbc", ".arxml"])
def test_kcd_is_read_whatever_its_extension(extension, dbc_file, tmp_path):
    file = tmp_path / f"car{extension}"
    file.write_text(cantools.database.load_file(dbc_file).as_kcd_string())
    assert [m.name for m in load_dbc(file).messages] == [m.name for m in load_dbc(dbc_file).messages]


def test_dbc_without_the_flag_of_29_bits_and_with_names_that_begin_with_a_digit_is_read(tmp_path):
    """Examples in commaai/opendbc: vw_mqbevo.dbc, psa_aee2010_r3.dbc, _stellantis_common.dbc."""
    file = tmp_path / "car.dbc"
    file.write_text('VERSION ""\nBU_: X\n\nBO_ 316522407 Wheel: 8 X\n SG_ 0_COUNTER : 0|4@1+ (1,0) [0|15] "" X\n'
                    ' SG_ Angle : 8|32@1- (.25,-.5) [-.5|1] "deg" X\n\nSIG_VALTYPE_ 316522407 Angle : 1;\n'
                    'VAL_ 316522407 0_COUNTER 15 "SNA" ;\nVAL_ 316522407 Angle 1 "a" 2 "cut;\n')
    with pytest.raises(ConfigurationError, match="not a valid DBC"):
        load_dbc(file)
    (message,) = load_dbc(file, ["Wheel"]).messages
    assert (message.frame_id, message.is_extended_frame) == (316522407, True)
    counter, angle = message.signals
    assert (counter.name, angle.scale, angle.offset, angle.conversion.is_float) == ("_0_COUNTER", 0.25, -0.5, True)
    assert (counter.choices, angle.choices) == ({15: "SNA"}, None)
