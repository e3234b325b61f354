"""Profiles load strictly, and a vehicle that cannot fly is refused with the numbers."""

import dataclasses
import math
from pathlib import Path

import pytest

from mavfi_cli.core.errors import ConfigError, UnknownName
from sitl.vehicle import profile as profile_module
from sitl.vehicle.profile import GRAVITY_MPS2, PROFILES, load_profile

SHIPPED = Path(profile_module.__file__).parent / "profiles"


def variant(tmp_path, old, new, name="solo"):
    text = (SHIPPED / f"{name}.toml").read_text()
    assert old in text
    path = tmp_path / "mine.toml"
    path.write_text(text.replace(old, new))
    return str(path)


def test_shipped_names():
    assert PROFILES.names == ["solo", "spark"]


@pytest.mark.parametrize("name", PROFILES.names)
def test_name_in_the_file_is_the_name(name):
    assert load_profile(name).name == name


def test_solo_is_the_published_one():
    solo = load_profile("solo")
    # T = 4 C_T rho n^2 D^4, AirSim's 3DR Solo: 38.03 N, T/W 2.58
    assert solo.mass_kg == 1.5
    assert solo.max_thrust_n == pytest.approx(38.03, abs=0.01)
    assert solo.max_thrust_n / (solo.mass_kg * GRAVITY_MPS2) == pytest.approx(2.58, abs=0.01)


def test_spark_is_in_its_class():
    spark = load_profile("spark")
    assert spark.mass_kg == 0.3
    assert 1.8 <= spark.max_thrust_n / (spark.mass_kg * GRAVITY_MPS2) <= 2.2


@pytest.mark.parametrize("name", PROFILES.names)
def test_motor_lag_is_tens_of_milliseconds(name):
    profile = load_profile(name)
    hover_n = profile.total_mass_kg * GRAVITY_MPS2 / 4.0
    assert 0.02 < profile.rotor.time_constant_s(hover_n) < 0.08


@pytest.mark.parametrize("name", PROFILES.names)
def test_box_holds_rotors_and_stands_clear_of_the_ground(name):
    profile = load_profile(name)
    reach = profile.rotor.arm_m / math.sqrt(2.0) + profile.rotor.diameter_m / 2.0
    assert profile.body_box_m[0] / 2.0 == pytest.approx(reach, abs=1e-3)
    assert profile.body_box_m[2] / 2.0 < profile.rest_height_m - 0.01


def test_unknown_name_gives_the_nearest():
    with pytest.raises(UnknownName, match=r"'sole'.* 'solo'"):
        load_profile("sole")


def test_by_path(tmp_path):
    path = variant(tmp_path, "mass_kg = 1.5", "mass_kg = 1.6")
    assert load_profile(path).mass_kg == 1.6


def test_missing_file():
    with pytest.raises(ConfigError, match=r"x\.toml: no such file"):
        load_profile("/nowhere/x.toml")


def test_unknown_key_names_file_line_and_nearest(tmp_path):
    path = variant(tmp_path, "diameter_m = 0.254", "diametr_m = 0.254")
    with pytest.raises(ConfigError, match=r"mine.toml:\d+: rotor.diametr_m.*'diameter_m'"):
        load_profile(path)


def test_too_heavy_in_a_file(tmp_path):
    path = variant(tmp_path, "mass_kg = 1.5", "mass_kg = 4.0")
    with pytest.raises(ConfigError, match=r"mine.toml.*38.0 N .* 4 kg"):
        load_profile(path)


def test_too_much_payload():
    with pytest.raises(ConfigError, match=r"1.5 kg \+ 3 kg payload \(44.1 N\).*0.86"):
        dataclasses.replace(load_profile("solo"), extra_payload_kg=3.0)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("mass_kg = 1.5", "mass_kg = -1.0", "mass_kg"),
        ("mass_kg = 1.5", "mass_kg = 0.0", "mass_kg"),
        ("capacity_ah = 5.2", "capacity_ah = 0.0", "capacity_ah"),
        ("tilt_deg = 35.0", "tilt_deg = 80.0", "at most 60"),
        ("cells = 4", "cells = 2", "7.4 V"),
        ("cells = 4", "cells = 4.5", "battery.cells"),
        ("arm_m = 0.130175", "arm_m = 0.0", "rotor.arm_m"),
        ("motor_resistance_ohm = 0.12", "motor_resistance_ohm = 0.0", "motor_resistance_ohm"),
        ("max_rpm = 7814.4", "max_rpm = -7814.4", "max_rpm"),
        ("body_box_m = [0.438, 0.438, 0.16]", "body_box_m = [0.438, 0.438]", "body_box_m"),
        ("horizontal_speed_mps = 12.0", "horizontal_speed_mps = 0.0", "horizontal_speed_mps"),
        ("leg_radius_m = 0.12", "leg_radius_m = 0.0", "leg_radius_m"),
        ("motor_resistance_ohm = 0.12", "motor_resistance_ohm = 5e-324", "in size, got 4.94"),
        ("max_rpm = 7814.4", "max_rpm = 1e200", "rotor.max_rpm: .*1e-12 and"),
    ],
)
def test_values_that_make_no_vehicle(tmp_path, old, new, words):
    with pytest.raises(ConfigError, match=words):
        load_profile(variant(tmp_path, old, new))


def test_payload_is_part_of_the_mass():
    loaded = dataclasses.replace(load_profile("solo"), extra_payload_kg=0.3)
    assert loaded.total_mass_kg == pytest.approx(1.8)
    assert loaded.gear_stiffness_npm > load_profile("solo").gear_stiffness_npm
