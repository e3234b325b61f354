"""A shipped vehicle that stands in for another: what is scaled, by which law, and that it flies."""

import math

import numpy as np
import pytest

from mavfi_cli.core.errors import ConfigError
from sitl.vehicle.profile import GRAVITY_MPS2, MIN_THRUST_TO_WEIGHT, load_profile

HEAVY = """name = "heavy"
base = "spark"
mass_kg = 0.3
extra_payload_kg = 0.417
rotor_pull_n = 8.331
hover_power_w = 63.0
battery_wh = 16.87
avionics_w = 30.0
"""


@pytest.fixture
def load(tmp_path):
    def of(text):
        path = tmp_path / "mine.toml"
        path.write_text(text)
        return load_profile(str(path))

    return of


def test_mass_pull_and_battery_are_those_of_the_other(load):
    heavy, spark = load(HEAVY), load_profile("spark")
    assert heavy.name == "heavy"
    assert heavy.total_mass_kg == pytest.approx(0.717)
    assert heavy.max_thrust_n == pytest.approx(8.331)
    battery = heavy.battery
    assert battery.cells * battery.cell_nominal_v * battery.capacity_ah == pytest.approx(16.87)
    assert battery.avionics_w == 30.0
    assert heavy.inertia_kgm2 == spark.inertia_kgm2  # payload is at the centre of mass
    assert (heavy.drag, heavy.body_box_m, heavy.gear) == (spark.drag, spark.body_box_m, spark.gear)
    assert heavy.rotor.full_throttle_voltage_v <= battery.cells * battery.cell_nominal_v


def test_hover_power_follows_momentum_theory(load):
    """P = T sqrt(T / (2 rho A)) over a figure of merit that C_T and C_P fix: P ~ m^1.5."""
    rotor = load(HEAVY).rotor
    merit = rotor.thrust_coefficient**1.5 / rotor.power_coefficient * math.sqrt(2.0 / math.pi)
    thrust_n = 0.3 * GRAVITY_MPS2 / 4.0
    area_m2 = math.pi * rotor.diameter_m**2 / 4.0
    ideal_w = 4.0 * thrust_n**1.5 / math.sqrt(2.0 * 1.225 * area_m2)
    assert rotor.hover_power_w(0.3) == pytest.approx(ideal_w / merit, rel=1e-9)
    assert rotor.hover_power_w(0.6) == pytest.approx(2.0**1.5 * rotor.hover_power_w(0.3))
    # faster turning of the same propellers changes what they can, not what hovering takes
    assert rotor.hover_power_w(0.3) == pytest.approx(load_profile("spark").rotor.hover_power_w(0.3))
    assert load(HEAVY).battery.drive_efficiency == pytest.approx(rotor.hover_power_w(0.3) / 63.0)


def test_the_record_s_hover_power_is_that_of_the_physics(airborne, setpoint):
    """JSBSim's propellers take it when the vehicle hovers."""
    flight = airborne("spark+0.1")
    flight.fly(setpoint(velocity=(0.0, 0.0, 0.0)), 3.0)
    told = flight.vehicle.profile.physics
    assert told["mass_kg"] == pytest.approx(0.4)
    assert flight.truth.power_propeller_w == pytest.approx(told["hover_shaft_w"], rel=0.02)


def test_a_bigger_vehicle_of_the_same_shape(load):
    big = load('name = "big"\nbase = "solo"\nmass_kg = 2.25\nrotor_pull_n = 60.0\n')
    solo = load_profile("solo")
    assert np.array(big.inertia_kgm2) == pytest.approx(1.5 * np.array(solo.inertia_kgm2))
    assert big.battery == solo.battery


@pytest.mark.parametrize(
    ("acceleration", "tilt_deg"),
    [(1.0, 35.0), (8.0, math.degrees(math.atan(8.0 / (0.9 * 9.80665)))), (40.0, 60.0)],
)
def test_the_tilt_limit_lets_it_accelerate(load, acceleration, tilt_deg):
    mine = load(f'name = "a"\nbase = "solo"\nacceleration_mps2 = {acceleration}\n')
    assert mine.limits.tilt_deg == pytest.approx(tilt_deg)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('base = "spark"', 'base = "sparc"', r"mine\.toml: base: .*'spark'"),
        ("mass_kg = 0.3", "mass_kg = -0.3", r"mine\.toml.*mass_kg: .*above 0, got -0\.3"),
        ("rotor_pull_n", "rotor_pul_n", r"mine\.toml:\d: rotor_pul_n: .*'rotor_pull_n'"),
        ("= 63.0", "= 6.3", r"mine\.toml: hover_power_w: .*at least the 2.* 0\.3 kg, got 6\.3"),
        ("= 0.417", "= 0.45", r"8\.3 N .* 0\.3 kg \+ 0\.45 kg .* got 1\.13"),
        ("= 30.0", "= -1.0", r"battery\.avionics_w: .*at least 0"),
    ],
)
def test_what_is_wrong_with_a_stand_in(load, old, new, said):
    with pytest.raises(ConfigError, match=said) as error:
        load(HEAVY.replace(old, new, 1))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("base", ["spark", "solo"])
def test_it_flies_at_the_least_thrust_to_weight(airborne, setpoint, base):
    """Climbs slowly, reaches 4 m/s and stops without losing height."""
    own = load_profile(base)
    payload_kg = own.max_thrust_n / (MIN_THRUST_TO_WEIGHT * GRAVITY_MPS2) - own.mass_kg
    flight = airborne(f"{base}+{payload_kg - 1e-6}")
    assert -flight.truth.position_ned_m[2] > 3.0
    speeding = flight.fly(setpoint(velocity=(4.0, 0.0, 0.0)), 6.0)
    np.testing.assert_allclose(speeding.velocity[-1], (4.0, 0.0, 0.0), atol=0.2)
    stopping = flight.fly(setpoint(velocity=(0.0, 0.0, 0.0)), 5.0)
    assert np.linalg.norm(stopping.velocity[-1]) < 0.15
    heights = -np.concatenate([speeding.position[:, 2], stopping.position[:, 2]])
    assert heights.max() - heights.min() < 0.3
    climbing = flight.fly(setpoint(velocity=(0.0, 0.0, -1.0)), 5.0)
    assert climbing.velocity[-1, 2] < -0.7
