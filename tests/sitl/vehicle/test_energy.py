"""Power regression against a numpy twin; the battery against its own equations."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sitl.vehicle.profile import PROFILES, load_profile
from sitl.vehicle.vehicle import (
    battery_current,
    open_circuit_voltage,
    regression_power,
)

components = st.lists(st.floats(-20.0, 20.0), min_size=3, max_size=3).map(np.array)


def twin(velocity, acceleration, energy, payload_kg):
    """The published equation, written over with whole vectors and in km/h."""
    v, a = 3.6 * velocity, 3.6 * acceleration
    vxy, axy, vz, az = np.hypot(*v[:2]), np.hypot(*a[:2]), abs(v[2]), abs(a[2])
    terms = np.array([vxy, axy, vxy * axy, vz, az, vz * az, 1000.0 * payload_kg, 1.0])
    e = energy
    return max(float(terms @ [e.b1, e.b2, e.b3, e.b4, e.b5, e.b6, e.b7, e.b9]), 0.0)


@settings(deadline=None)  # the first call may compile
@given(components, components, st.floats(0.0, 1.0), st.sampled_from(PROFILES.names))
def test_regression_is_its_twin(velocity, acceleration, payload_kg, name):
    energy = load_profile(name).energy
    power = regression_power(velocity, acceleration, energy.coefficients(payload_kg))
    assert power == pytest.approx(twin(velocity, acceleration, energy, payload_kg), rel=1e-9)


def test_regression_reproduces_the_published_check():
    # Solo at 2 m/s with 0.5 m/s^2 along and 0.2 m/s^2 up: 522 W by the equation, 527 W recorded.
    b = load_profile("solo").energy.coefficients(0.0)
    power = regression_power(np.array([2.0, 0.0, 0.0]), np.array([0.5, 0.0, -0.2]), b)
    assert power == pytest.approx(522.0, abs=1.0)


def test_hovering_solo_takes_the_constant(airborne, setpoint):
    flight = airborne("solo")
    before = flight.truth.energy_regression_j
    flight.fly(setpoint(velocity=(0.0, 0.0, 0.0)), 10.0)
    assert flight.truth.power_regression_w == pytest.approx(443.9, abs=1.0)
    assert flight.truth.energy_regression_j - before == pytest.approx(4439.0, rel=0.01)


@pytest.mark.parametrize("name", PROFILES.names)
def test_open_circuit_voltage_rises_with_charge(name):
    battery = load_profile(name).battery
    parameters = battery.parameters()
    volts = [open_circuit_voltage(charge, parameters) for charge in np.linspace(0.0, 1.0, 101)]
    assert (np.diff(volts) > 0.0).all()
    assert volts[0] == pytest.approx(battery.cells * battery.cell_empty_v)
    assert volts[-1] == pytest.approx(battery.cells * battery.cell_full_v)


@settings(deadline=None)  # the first call may compile
@given(st.floats(0.0, 200.0), st.floats(9.0, 17.0), st.floats(0.0, 0.1))
def test_current_delivers_the_power(power_w, open_v, resistance_ohm):
    current = battery_current(power_w, open_v, resistance_ohm)
    assert current * (open_v - current * resistance_ohm) == pytest.approx(power_w, abs=1e-6)
    assert current <= 2.0 * power_w / open_v + 1e-12


def test_no_battery_delivers_more_than_it_can():
    assert battery_current(1e6, 10.0, 0.1) == pytest.approx(50.0)  # V / 2R


@pytest.mark.parametrize(("name", "minutes"), [("solo", (20, 32)), ("spark", (13, 18))])
def test_battery_lasts_as_long_as_the_real_one(airborne, setpoint, name, minutes):
    flight = airborne(name)
    battery = flight.vehicle.profile.battery
    start = flight.truth.battery_remaining
    amperes = flight.fly(setpoint(velocity=(0.0, 0.0, 0.0)), 30.0).rows[:, 27]
    used = start - flight.truth.battery_remaining
    charge_as = amperes.sum() * 0.004
    assert used == pytest.approx(charge_as / (3600.0 * battery.capacity_ah), rel=1e-9)
    assert minutes[0] < 30.0 / used / 60.0 < minutes[1]
    assert flight.truth.battery_voltage_v < battery.cells * battery.cell_full_v


@pytest.mark.parametrize("name", ["solo", "spark", "solo+0.3"])
def test_hover_power_is_that_of_the_propeller_equations(airborne, setpoint, name):
    flight = airborne(name)
    flight.fly(setpoint(velocity=(0.0, 0.0, 0.0)), 20.0)
    profile, truth = flight.vehicle.profile, flight.truth
    rotor = profile.rotor
    # T = C_T rho n^2 D^4 = m g / 4 and P = C_P rho n^3 D^5, at the density of 3 to 4 m height
    density = 1.225 * (1.0 - 2.25577e-5 * -truth.position_ned_m[2]) ** 4.2559
    thrust_n = profile.total_mass_kg * 9.80665 / 4.0
    speed_hz = math.sqrt(thrust_n / (rotor.thrust_coefficient * density * rotor.diameter_m**4))
    np.testing.assert_allclose(truth.motor_rpm, 60.0 * speed_hz, rtol=1e-3)
    power_w = 4.0 * rotor.power_coefficient * density * speed_hz**3 * rotor.diameter_m**5
    assert truth.power_propeller_w == pytest.approx(power_w, rel=2e-3)
    before = truth.energy_propeller_j
    flight.fly(setpoint(velocity=(0.0, 0.0, 0.0)), 10.0)
    assert truth.energy_propeller_j - before == pytest.approx(10.0 * power_w, rel=2e-3)
