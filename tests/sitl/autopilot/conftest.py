import math

import numpy as np
import pytest

from mavfi_cli.link.codec import Codec, dialect
from sitl.autopilot.autopilot import Autopilot
from sitl.autopilot.services import handle
from sitl.autopilot.telemetry import TICK_US, Preset
from sitl.vehicle.truth import Truth

NAN = math.nan
REST_M = 0.1
GUIDE, GUIDE_COMPONENT = 245, 190


class PointVehicle:
    """A vehicle without dynamics: it flies what is asked, and stands on the ground."""

    euler_rad, in_body = Truth.euler_rad, Truth.in_body

    def __init__(self):
        self.position_ned_m = np.array([0.0, 0.0, -REST_M])
        self.velocity_ned_mps = np.zeros(3)
        self.acceleration_ned_mps2 = np.zeros(3)
        self.quaternion_frd_ned = np.array([1.0, 0.0, 0.0, 0.0])
        self.rates_frd_radps = np.zeros(3)
        self.motor_commands = np.zeros(4)
        self.on_ground = True
        self.battery_voltage_v = 16.0
        self.battery_current_a = 10.0
        self.battery_remaining = 0.9

    def move(self, setpoint, motors_on, dt):
        position, velocity = setpoint[0:3], setpoint[3:6]
        wanted = np.where(np.isnan(velocity), 0.0, velocity)
        pull = 2.0 * (position - self.position_ned_m)
        wanted = wanted + np.where(np.isnan(position), 0.0, np.clip(pull, -3.0, 3.0))
        if not motors_on:
            wanted = np.array([0.0, 0.0, 0.0 if self.on_ground else 3.0])
        self.velocity_ned_mps = self.velocity_ned_mps + 0.2 * (wanted - self.velocity_ned_mps)
        self.position_ned_m = self.position_ned_m + dt * self.velocity_ned_mps
        self.on_ground = bool(self.position_ned_m[2] >= -REST_M)
        if self.on_ground:
            self.position_ned_m[2] = -REST_M
            self.velocity_ned_mps = np.zeros(3)
        if motors_on and not np.isnan(setpoint[9]):
            yaw = setpoint[9]
            self.quaternion_frd_ned = np.array([math.cos(yaw / 2), 0, 0, math.sin(yaw / 2)])


class Bench:
    """An autopilot on a point vehicle with one client, all of it over encoded frames."""

    def __init__(self, preset=Preset.LOCKSTEP):
        self.link_preset = preset
        self.vehicle = PointVehicle()
        self.autopilot = Autopilot(self.vehicle)
        self.link = self.autopilot.open_link(preset)
        self.stamp_us = 0
        self.received = []
        self.modes = []
        self._out = Codec(GUIDE, GUIDE_COMPONENT)
        self._server_in = Codec(1, 1)
        self._server_out = Codec(1, 1)
        self._in = Codec(GUIDE, GUIDE_COMPONENT)
        self.autopilot.observe(0, self.vehicle)

    @property
    def commander(self):
        return self.autopilot.commander

    @property
    def mode(self):
        return self.commander.mode

    def send(self, message, link=None):
        for received in self._server_in.decode(self._out.encode(message)):
            handle(self.autopilot, received, link or self.link)

    def command(self, number, *parameters, system=1, component=1):
        given = [*parameters, *([NAN] * (7 - len(parameters)))]
        self.send(dialect.MAVLink_command_long_message(system, component, number, 0, *given))

    def run(self, seconds, stream=None, every=1):
        """Advance; `stream` makes the message that a client sends at every `every`-th tick."""
        for tick in range(round(seconds * 1e6 / TICK_US)):
            if stream is not None and tick % every == 0:
                self.send(stream())
            self.tick()

    def tick(self):
        self.autopilot.fly()
        now = self.autopilot.snapshot
        self.vehicle.move(now.setpoint, now.motors_on, TICK_US * 1e-6)
        self.stamp_us += TICK_US
        self.autopilot.observe(self.stamp_us, self.vehicle)
        self.modes.append(self.mode)
        for message in self.autopilot.collect(self.link):
            self.received += self._in.decode(self._server_out.encode(message))

    def run_until(self, condition, limit_s=120.0):
        start = self.stamp_us
        while not condition():
            assert self.stamp_us - start < limit_s * 1e6, "it never happened"
            self.tick()

    def take(self, kind):
        """Messages of a kind received since the last call, in order."""
        found = [m for m in self.received if m.get_type() == kind]
        self.received = [m for m in self.received if m.get_type() != kind]
        return found

    def texts(self):
        """STATUSTEXTs since the last call as (severity, text), chunks put together."""
        whole = []
        for message in self.take("STATUSTEXT"):
            text = message.text
            if message.chunk_seq:
                severity, head = whole.pop()
                whole.append((severity, head + text))
            else:
                whole.append((message.severity, text))
        return [(severity, text.removesuffix("\t")) for severity, text in whole]

    def acks(self):
        """Command and result of every COMMAND_ACK since the last call."""
        self.tick()
        acks = self.take("COMMAND_ACK")
        assert all((a.target_system, a.target_component) == (GUIDE, 190) for a in acks)
        return [(a.command, a.result) for a in acks]

    def fly(self):
        """Ready, armed, taken off to the default height, texts and acks forgotten."""
        self.run(4.5)
        self.command(dialect.MAV_CMD_COMPONENT_ARM_DISARM, 1)
        self.command(dialect.MAV_CMD_NAV_TAKEOFF)
        self.run(12.0)
        assert self.commander.armed
        assert not self.commander.landed
        self.received.clear()
        return self


def velocity(north=0.0, east=0.0, down=0.0, yaw=0.0, **changes):
    """SET_POSITION_TARGET_LOCAL_NED with velocity and yaw, as MAVSDK sends it."""
    fields = {
        "time_boot_ms": 0, "target_system": 1, "target_component": 1, "coordinate_frame": 1,
        "type_mask": 2503, "x": 0.0, "y": 0.0, "z": 0.0, "vx": north, "vy": east, "vz": down,
        "afx": 0.0, "afy": 0.0, "afz": 0.0, "yaw": yaw, "yaw_rate": 0.0, **changes,
    }  # fmt: skip
    return dialect.MAVLink_set_position_target_local_ned_message(**fields)


@pytest.fixture
def bench():
    return Bench()


@pytest.fixture
def flying():
    return Bench().fly()


@pytest.fixture(scope="session")
def make_bench():
    return Bench


@pytest.fixture
def velocity_target():
    return velocity
