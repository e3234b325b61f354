"""JSBSim's model against closed forms: the files say what the profile says."""

import math

import numpy as np
import pytest

from mavfi_cli.core.errors import VehicleProcessError
from sitl.vehicle.cascade import throttle
from sitl.vehicle.gains import gains_for
from sitl.vehicle.physics import (
    AIRCRAFT,
    FOOT_M,
    RAW_POSITION,
    RAW_RATES,
    RAW_RPM,
    RAW_SIZE,
    RAW_VELOCITY,
    Physics,
    power_share,
    thrust_share,
    write_model,
)
from sitl.vehicle.profile import GRAVITY_MPS2, PROFILES, load_profile

DT_S = 0.004


def bench(name, height_m):
    profile = load_profile(name)
    physics = Physics(
        profile,
        position_ned_m=np.array([0.0, 0.0, -height_m]),
        heading_rad=0.0,
        dt_s=DT_S,
    )
    return profile, physics


def read(physics):
    raw = np.zeros(RAW_SIZE)
    physics.read(raw)
    return raw


@pytest.mark.parametrize("name", PROFILES.names)
@pytest.mark.parametrize("share", [0.02, 0.1, 0.3])
def test_throttle_gives_the_rotor_speed_of_its_thrust_share(name, share):
    profile, physics = bench(name, load_profile(name).rest_height_m)
    command = throttle(share, gains_for(profile, DT_S))
    for _ in range(500):
        physics.advance(np.full(4, command))
    rpm = read(physics)[RAW_RPM : RAW_RPM + 4]
    np.testing.assert_allclose(rpm, math.sqrt(share) * profile.rotor.max_rpm, rtol=2e-3)


@pytest.mark.parametrize("name", PROFILES.names)
def test_motor_lag_is_the_predicted_one(name):
    profile, physics = bench(name, load_profile(name).rest_height_m)
    gains = gains_for(profile, DT_S)
    low, high = (throttle(share, gains) for share in (0.15, 0.17))
    for _ in range(500):
        physics.advance(np.full(4, low))
    start = read(physics)[RAW_RPM]
    trace = []
    for _ in range(200):
        physics.advance(np.full(4, high))
        trace.append(read(physics)[RAW_RPM])
    rise = (np.array(trace) - start) / (trace[-1] - start)
    measured_s = (np.argmax(rise > 1.0 - math.exp(-1.0)) + 1) * DT_S
    expected_s = profile.rotor.time_constant_s(0.16 * profile.rotor.max_thrust_n)
    assert measured_s == pytest.approx(expected_s, abs=1.5 * DT_S)


@pytest.mark.parametrize("name", PROFILES.names)
def test_fall_with_drag(name):
    profile, physics = bench(name, 100.0)
    speed, fallen, fine = 0.0, 0.0, DT_S / 100
    linear, quadratic = profile.drag.linear_nspm[2], profile.drag.quadratic_ns2pm2[2]
    for _ in range(500 * 100):
        force = linear * speed + quadratic * speed**2
        speed += fine * (GRAVITY_MPS2 - force / profile.mass_kg)
        fallen += fine * speed
    for _ in range(500):
        physics.advance(np.zeros(4))
    raw = read(physics)
    assert -raw[RAW_VELOCITY + 2] * FOOT_M == pytest.approx(speed, rel=5e-3)
    assert raw[RAW_POSITION] == pytest.approx(0.0, abs=1e-6)
    assert raw[RAW_POSITION + 1] == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize(
    ("rotor", "signs"),
    # front right, rear left, front left, rear right; roll right, pitch up, yaw right positive
    [(0, (-1, 1, 1)), (1, (1, -1, 1)), (2, (1, 1, -1)), (3, (-1, -1, -1))],
)
def test_each_rotor_turns_the_body_its_way(rotor, signs):
    _, physics = bench("solo", 50.0)
    for _ in range(100):
        physics.advance(np.full(4, 0.5))
    commands = np.full(4, 0.5)
    commands[rotor] = 0.55
    before = read(physics)[RAW_RATES : RAW_RATES + 3]
    for _ in range(15):
        physics.advance(commands)
    change = read(physics)[RAW_RATES : RAW_RATES + 3] - before
    assert tuple(np.sign(change).astype(int)) == signs


def test_propeller_shares_at_their_ends():
    for share in (thrust_share, power_share):
        assert share(0.0) == 1.0
        assert share(-0.5) > 1.0
    assert thrust_share(1.0) == pytest.approx(0.0)
    assert thrust_share(1.2) < 0.0
    assert power_share(1.5) > 0.0


def test_model_files_are_ours_and_whole(tmp_path):
    write_model(load_profile("solo"), tmp_path)
    files = sorted(str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*") if p.is_file())
    assert files == [
        f"aircraft/{AIRCRAFT}/{AIRCRAFT}.xml",
        "engine/motor.xml",
        "engine/propeller.xml",
        "planet.xml",
    ]


def test_no_room_for_the_model_files_is_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "missing"))
    with pytest.raises(VehicleProcessError, match="model of vehicle 'solo'"):
        bench("solo", 1.0)
