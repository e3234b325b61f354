"""Starts PX4 and serves its lockstep link (sensors out, motor outputs back, over TCP).

PX4 is the client. HIL_SENSOR sets its clock, and HIL_ACTUATOR_CONTROLS answers it once the
controllers have run. PX4 sends no answer while no controller runs, so a missing answer must not
stop the simulation.
"""

from __future__ import annotations

import fcntl
import math
import os
import socket
import time
from pathlib import Path

import numpy as np

from mavfi_cli.core.errors import LinkError, LinkLost, VehicleProcessError
from mavfi_cli.core.files import ScratchFolder
from mavfi_cli.core.frames import Vector
from mavfi_cli.link.codec import Codec, Message, dialect
from mavfi_cli.link.transport import Transport, open_transport
from sitl.firmware.autopilot import FIXED_PARAMETERS, Boot, FirmwareProcess
from sitl.firmware.sensors import Sensors
from sitl.vehicle.gains import RateLoops
from sitl.vehicle.profile import VehicleProfile
from sitl.vehicle.truth import Truth

PORT = 4560
_MAG_STEPS = 5  # 50 Hz
_BARO_STEPS = 10  # 25 Hz
_FIX_STEPS = 25  # 10 Hz

_INERTIAL_FIELDS = 0x003F
_MAG_FIELDS = 0x01C0
_BARO_FIELDS = 0x1A00  # pressure, altitude and temperature
_TEMPERATURE_C = 15.0
_FIX_3D, _SATELLITES = 3, 10
_EPH_CM, _EPV_CM = 90, 178
_ARMED = dialect.MAV_MODE_FLAG_SAFETY_ARMED

ANSWER_LIMIT_S = 1.0  # wait for an answer if the step before was answered
SILENT_WAIT_S = 0.004  # wait if it was not
_GONE = "PX4 closed the simulator link"

_INSTANCES = 100  # maximum number of PX4 instances on a machine
_SOCKET = "/tmp/px4-sock-{}"  # where a running instance accepts commands
_CLAIM = "/tmp/mavfi-px4-{}"  # locked by the flight whose PX4 has this instance
_LOCAL_PORT = 14_580  # MAVLink port of the first instance
_TILT_SHARE = math.sqrt(0.5)  # share of each rotor's thrust at full roll or pitch
_ROTORS = ((1, 1, 1), (-1, -1, 1), (1, -1, -1), (-1, 1, -1))  # forward, right, sense

# PX4 sources these scripts instead of its own. They set the vehicle's parameters before its modules
# start, and open a link to a companion but no other links.
_SIMULATOR_SCRIPT = """#!/bin/sh
{settings}
simulator_mavlink start -c {port}
"""
_LINKS_SCRIPT = """#!/bin/sh
mavlink start -x -u {local} -r 4000000 -f -m onboard -o {remote}
"""


class Px4Link:
    """The simulator link to one PX4. The TCP port determines the number of the PX4 instance."""

    step_s = 0.004  # PX4's SITL takes inertial samples at 250 Hz
    settle_s = 12.0  # its boot time varies between flights; its estimator has settled by then
    echoes = True

    def __init__(
        self, transport: Transport, sensors: Sensors, port: int = PORT, claim: int | None = None
    ) -> None:
        self._transport, self._claim = transport, claim
        self.port = port
        self._sensors = sensors
        self._codec = Codec(1, dialect.MAV_COMP_ID_AUTOPILOT1)
        self._throttles = np.zeros(4)
        self._steps = 0
        self._has_called = self._answers = False

    @classmethod
    def open(cls, sensors: Sensors, *, ours: bool) -> Px4Link:
        """Open a TCP port to which a PX4 instance connects, and return the link on it.

        If we start PX4 (`ours`), this is the first free port of all instances. Otherwise it is the
        port of the first instance. Raises LinkError if no such port can be opened.
        """
        *others, last = range(PORT, PORT + (_INSTANCES if ours else 1))
        for port in others:
            if (claim := _claimed(port - PORT)) is None:
                continue
            try:
                return cls(open_transport(f"tcpin:127.0.0.1:{port}"), sensors, port, claim)
            except LinkError:
                os.close(claim)
        return cls(open_transport(f"tcpin:127.0.0.1:{last}"), sensors, last)

    @staticmethod
    def parameters(profile: VehicleProfile) -> dict[str, float]:
        """Return the PX4 parameters that a vehicle needs, keyed by name.

        They set the rotors, the thrust curve and the rate loops.
        """
        loops, offset_m = RateLoops.of(profile), profile.rotor.arm_m / math.sqrt(2.0)
        parameters = FIXED_PARAMETERS["px4"].copy()
        for rotor, (forward, right, sense) in enumerate(_ROTORS):
            parameters[f"CA_ROTOR{rotor}_PX"] = forward * offset_m
            parameters[f"CA_ROTOR{rotor}_PY"] = right * offset_m
            parameters[f"CA_ROTOR{rotor}_KM"] = sense * profile.rotor.torque_per_thrust_m
            parameters[f"PWM_MAIN_FUNC{rotor + 1}"] = 101 + rotor
        shares = (_TILT_SHARE, _TILT_SHARE, 1.0)
        return {
            **parameters,
            **loops.parameters("MC_{axis}RATE_{term}", ("ROLL", "PITCH", "YAW"), shares),
            "MC_ROLL_P": loops.tilt_p,
            "MC_PITCH_P": loops.tilt_p,
            "THR_MDL_FAC": loops.curve,
            "MPC_THR_HOVER": loops.hover_share,
        }

    def start(self, binary: Path, boot: Boot) -> FirmwareProcess:
        """Start PX4's SITL binary, which then connects to this link.

        The binary's folder, such as `bin/`, must be next to `etc/` with PX4's startup files. PX4
        derives its heading from the magnetometer. Raises VehicleProcessError if it cannot be
        started.
        """
        program = FirmwareProcess.program(binary)
        startup = program.parent.parent / "etc"
        if not (startup / "init.d-posix" / "rcS").is_file():
            raise VehicleProcessError(
                f"{binary} is not PX4's SITL binary: PX4's startup files are not in {startup}"
            )
        scratch = ScratchFolder("px4")
        folder, instance = scratch.path, self.port - PORT
        parameters = {**self.parameters(boot.profile), "MAV_SYS_ID": boot.system_id}
        settings = [f"param set {name} {value:.6g}" for name, value in parameters.items()]
        simulator = _SIMULATOR_SCRIPT.format(settings="\n".join(settings), port=self.port)
        (folder / "px4-rc.simulator").write_text(simulator)
        links = _LINKS_SCRIPT.format(local=_LOCAL_PORT + instance, remote=boot.mavlink_port)
        (folder / "px4-rc.mavlink").write_text(links)
        environment = {
            "PX4_SIM_MODEL": "none_iris",
            "PATH": f"{folder}:{program.parent}:{os.environ.get('PATH', '')}",
        }
        arguments = ["-d", "-i", str(instance), "-w", str(folder), str(startup)]
        return FirmwareProcess(program, arguments, scratch, environment)

    def has_called(self, timeout_s: float) -> bool:
        """Return True if PX4 has sent a message, after waiting at most `timeout_s` for one."""
        if not self._has_called:
            self._take(timeout_s)
        return self._has_called

    def exchange(self, stamp_us: int, truth: Truth) -> Vector:
        """Send the sensor values of a physics step. Return PX4's newest motor outputs (4,), 0..1.

        Raises VehicleProcessError if PX4 has closed the link.
        """
        messages = [self._hil_sensor(stamp_us, truth)]
        if self._steps % _FIX_STEPS == 0:
            messages.insert(0, self._hil_gps(stamp_us, truth))
        self._steps += 1
        try:
            self._transport.send(b"".join(map(self._codec.encode, messages)))
        except LinkLost:
            raise VehicleProcessError(_GONE) from None
        self._await_answer(stamp_us)
        return self._throttles

    def close(self) -> None:
        """Close the link, and let other flights have the instance of PX4."""
        self._transport.close()
        if self._claim is not None:
            os.close(self._claim)
            self._claim = None

    def _await_answer(self, stamp_us: int) -> None:
        limit_s = ANSWER_LIMIT_S if self._answers else SILENT_WAIT_S
        deadline_s, remaining_s, self._answers = time.monotonic() + limit_s, limit_s, False
        while remaining_s > 0.0 and not self._answers:
            remaining_s = deadline_s - time.monotonic()
            self._answers = self._take(max(remaining_s, 0.0)) >= stamp_us

    def _take(self, timeout_s: float) -> int:
        """Wait at most `timeout_s` for bytes, and handle the messages in them.

        Return the newest stamp, us, that these messages answer, or -1 if they answer none.
        """
        try:
            data = self._transport.receive(timeout_s)
        except LinkLost:
            raise VehicleProcessError(_GONE) from None
        answered = -1
        for message in self._codec.decode(data) if data else ():
            self._has_called = True
            if message.get_msgId() == dialect.MAVLINK_MSG_ID_HIL_ACTUATOR_CONTROLS:
                answered = message.time_usec
                self._throttles = _throttles(message)
        return answered

    def _hil_sensor(self, stamp_us: int, truth: Truth) -> Message:
        sensors, fields = self._sensors, _INERTIAL_FIELDS
        rates, force = sensors.inertial(truth)
        magnetic, pressure, altitude_m = (0.0, 0.0, 0.0), 0.0, 0.0
        if self._steps % _MAG_STEPS == 0:
            fields |= _MAG_FIELDS
            magnetic = tuple(sensors.magnetic_field(truth).tolist())
        if self._steps % _BARO_STEPS == 0:
            fields |= _BARO_FIELDS
            pressure, altitude_m = sensors.barometer(truth)
        return dialect.MAVLink_hil_sensor_message(
            stamp_us, *force.tolist(), *rates.tolist(), *magnetic, pressure / 100.0, 0.0,
            altitude_m, _TEMPERATURE_C, fields,
        )  # fmt: skip

    def _hil_gps(self, stamp_us: int, truth: Truth) -> Message:
        latitude_deg, longitude_deg, altitude_m, velocity = self._sensors.fix(truth)
        north, east, down = velocity.tolist()
        course_deg = math.degrees(math.atan2(east, north)) % 360.0
        return dialect.MAVLink_hil_gps_message(
            stamp_us, _FIX_3D, round(latitude_deg * 1e7), round(longitude_deg * 1e7),
            round(altitude_m * 1e3), _EPH_CM, _EPV_CM,
            round(100.0 * math.hypot(north, east)), round(100.0 * north), round(100.0 * east),
            round(100.0 * down), round(100.0 * course_deg) % 36_000, _SATELLITES,
        )  # fmt: skip


def _throttles(message: Message) -> Vector:
    """Return the outputs (4,), in 0..1, of the four motors in HIL_ACTUATOR_CONTROLS.

    An output of NaN counts as 0. While PX4 is disarmed, all outputs are 0.
    """
    if not message.mode & _ARMED:
        return np.zeros(4)
    return np.clip(np.nan_to_num(np.array(message.controls[:4], dtype=np.float64)), 0.0, 1.0)


def _claimed(instance: int) -> int | None:
    """Claim a PX4 instance for this flight. Return a descriptor, or None if the instance is taken.

    Ports do not suffice: flights in networks of their own have the same ports, but PX4 locks its
    instance in /tmp. The claim ends when the descriptor is closed.
    """
    if _is_running(instance):
        return None
    try:
        flags = os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
        claim = os.open(_CLAIM.format(instance), flags, 0o600)
    except OSError:  # another user's, or no file
        return None
    try:
        fcntl.flock(claim, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(claim)
        return None
    return claim


def _is_running(instance: int) -> bool:
    """Return True if a PX4 instance with this number already runs, so that another cannot start."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        return probe.connect_ex(_SOCKET.format(instance)) == 0
