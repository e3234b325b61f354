import math
from collections import Counter

import pytest

from sitl.autopilot.telemetry import BUILDERS, Preset

WIRE_RATES = {
    Preset.ONBOARD: {
        "ATTITUDE": 50, "LOCAL_POSITION_NED": 30, "ODOMETRY": 30, "GPS_RAW_INT": 8,
        "SYS_STATUS": 5, "EXTENDED_SYS_STATE": 5, "HEARTBEAT": 1, "SYSTEM_TIME": 1,
        "BATTERY_STATUS": 0.5, "HOME_POSITION": 0.5, "TIMESYNC": 10, "VFR_HUD": 10,
        "GLOBAL_POSITION_INT": 50, "ALTITUDE": 10,
    },
    Preset.GCS: {"ATTITUDE": 50, "SYS_STATUS": 1, "VFR_HUD": 4, "GPS_RAW_INT": 5, "ALTITUDE": 1},
    Preset.LOCKSTEP: {
        "LOCAL_POSITION_NED": 50, "ATTITUDE_QUATERNION": 50, "HEARTBEAT": 1, "SYS_STATUS": 1,
        "EXTENDED_SYS_STATE": 5, "BATTERY_STATUS": 0.5, "HOME_POSITION": 0.5,
    },
}  # fmt: skip


@pytest.mark.parametrize("preset", Preset)
def test_rates_are_those_of_the_preset(make_bench, preset):
    bench = make_bench(preset)
    bench.run(5.0)
    bench.received.clear()
    bench.run(10.0)
    counted = Counter(message.get_type() for message in bench.received)
    for kind, rate_hz in WIRE_RATES[preset].items():
        assert counted[kind] == pytest.approx(10 * rate_hz, abs=1), kind
    if preset is Preset.LOCKSTEP:
        assert set(counted) == set(WIRE_RATES[preset])


def test_position_closes_every_lockstep_batch(bench):
    bench.run(3.0)
    for _ in range(200):
        bench.autopilot.fly()
        bench.stamp_us += 20_000
        bench.autopilot.observe(bench.stamp_us, bench.vehicle)
        last = bench.autopilot.collect(bench.link)[-1]
        assert last.get_type() == "LOCAL_POSITION_NED"
        assert last.time_boot_ms == bench.stamp_us // 1000


def test_every_message_can_be_built_and_sent(make_bench):
    bench = make_bench(Preset.ONBOARD)
    bench.vehicle.position_ned_m[:] = [1e7, -1e7, -1e6]  # far outside the fields' ranges
    bench.vehicle.velocity_ned_mps[:] = [1e4, -1e4, 1e4]
    bench.vehicle.on_ground = False
    bench.vehicle.battery_voltage_v = 1e6
    bench.vehicle.battery_current_a = math.nan
    for number in BUILDERS:
        bench.link.set_interval(number, 20_000, 0)
    for stamp_us in (1_000_000, 10_000_000, 5_000_000_000_000):
        bench.stamp_us = stamp_us
        bench.tick()
    sent = {message.get_msgId() for message in bench.received}
    assert sent == set(BUILDERS)


def test_attitude_and_quaternion_tell_the_same(make_bench):
    bench = make_bench(Preset.ONBOARD)
    roll, pitch, yaw = 0.2, -0.3, 2.5
    half = [math.cos(a / 2) for a in (roll, pitch, yaw)] + [
        math.sin(a / 2) for a in (roll, pitch, yaw)
    ]
    cr, cp, cy, sr, sp, sy = half
    bench.vehicle.quaternion_frd_ned[:] = [
        cr * cp * cy + sr * sp * sy, sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy, cr * cp * sy - sr * sp * cy,
    ]  # fmt: skip
    bench.tick()
    (attitude,) = bench.take("ATTITUDE")
    assert [attitude.roll, attitude.pitch, attitude.yaw] == pytest.approx([roll, pitch, yaw])


def test_odometry_velocity_is_in_the_body_frame(make_bench):
    bench = make_bench(Preset.ONBOARD)
    bench.vehicle.quaternion_frd_ned[:] = [math.sqrt(0.5), 0, 0, math.sqrt(0.5)]  # nose east
    bench.vehicle.velocity_ned_mps[:] = [0.0, 3.0, 1.0]
    bench.autopilot.observe(40_000, bench.vehicle)
    odometry = BUILDERS[331](bench.autopilot.snapshot)
    assert [odometry.vx, odometry.vy, odometry.vz] == pytest.approx([3.0, 0.0, 1.0], abs=1e-9)


def test_global_position_appears_after_fusion(make_bench):
    bench = make_bench(Preset.ONBOARD)
    bench.run(3.0)
    assert not bench.take("GLOBAL_POSITION_INT")
    bench.run(1.0)
    position = bench.take("GLOBAL_POSITION_INT")[-1]
    assert position.lat == pytest.approx(473977420, abs=2)
    assert position.alt == pytest.approx(489_500, abs=2)
    assert position.relative_alt == pytest.approx(0, abs=2)
