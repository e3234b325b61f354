"""Starts ArduPilot and serves its JSON backend (servo outputs in, state out, over UDP).

ArduPilot sends its outputs and waits for the state, whose timestamp is its clock. It simulates
barometer, magnetometer and GPS itself.
"""

from __future__ import annotations

import json
import socket
import struct
import time
from pathlib import Path
from typing import Any

import numpy as np

from mavfi_cli.core.errors import LinkError, VehicleProcessError
from mavfi_cli.core.files import ScratchFolder
from mavfi_cli.core.frames import Vector
from mavfi_cli.link.codec import Codec
from sitl.firmware.autopilot import FIXED_PARAMETERS, Boot, FirmwareProcess
from sitl.firmware.sensors import Sensors
from sitl.geodesy import Origin
from sitl.vehicle.gains import RateLoops
from sitl.vehicle.profile import VehicleProfile
from sitl.vehicle.truth import Truth

PORT = 9002
_LOOPBACK = "127.0.0.1"
_SERVOS = struct.Struct("<HHI16H")
_MAGIC = 18458
_LEAST_US, _SPAN_US = 1000.0, 1000.0
ANSWER_LIMIT_S = 10.0
_EPOCH_S = 1_600_000_000  # start of its clock: the same in every flight
_FULL_SHARE = 0.5  # share of the rotors' torque that its mixer gives at full command


class ArduPilotLink:
    """The link to one ArduPilot, whose JSON backend sends its outputs to our UDP port.

    Port 0 selects any free port. Raises LinkError if the port cannot be opened.
    """

    step_s = 0.00125  # ArduCopter arms only if the gyro is faster than 1.8 times its loop of 400 Hz
    settle_s = 0.0  # its boot takes the same simulated time in every flight
    echoes = False

    def __init__(self, sensors: Sensors, port: int = PORT) -> None:
        Codec.add_ardupilot()  # clients such as DroneKit read EKF_STATUS_REPORT
        self._sensors = sensors
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind((_LOOPBACK, port))
        except OSError as error:
            self._socket.close()
            raise LinkError(f"cannot open UDP port {port}: {error.strerror or error}") from None
        self._peer: Any = None
        self._frame = -1
        self._throttles = np.zeros(4)

    @classmethod
    def open(cls, sensors: Sensors, *, ours: bool) -> ArduPilotLink:
        """Open a free UDP port if we start ArduPilot (`ours`), otherwise ArduPilot's usual port.

        Raises LinkError if the port cannot be opened.
        """
        return cls(sensors, 0 if ours else PORT)

    @staticmethod
    def parameters(profile: VehicleProfile) -> dict[str, float]:
        """Return the ArduCopter parameters that a vehicle needs, keyed by name.

        They set the frame, the thrust curve and the rate loops.
        """
        loops = RateLoops.of(profile)
        return {
            **FIXED_PARAMETERS["ardupilot"],
            "MOT_THST_EXPO": loops.curve,
            "MOT_THST_HOVER": loops.hover_share,
            **loops.parameters("ATC_RAT_{axis}_{term}", ("RLL", "PIT", "YAW"), [_FULL_SHARE] * 3),
        }

    def start(self, binary: Path, boot: Boot) -> FirmwareProcess:
        """Start ArduCopter's SITL binary, which then connects to this link.

        Raises VehicleProcessError if it cannot be started.
        """
        program, origin = FirmwareProcess.program(binary), Origin()
        scratch = ScratchFolder("ardupilot")
        lines = [f"{name} {value:.6g}\n" for name, value in self.parameters(boot.profile).items()]
        (scratch.path / "vehicle.parm").write_text("".join(lines))
        home = (origin.latitude_deg, origin.longitude_deg, origin.altitude_amsl_m, boot.heading_deg)
        arguments = [
            "--model", f"JSON:{_LOOPBACK}", "--wipe", "--speedup", "100",
            "--defaults", "vehicle.parm", "--sysid", str(boot.system_id),
            "--home", ",".join(f"{value:.7f}" for value in home),
            "--start-time", str(_EPOCH_S),
            "--sim-port-out", str(self.port), "--sim-port-in", "0", "--rc-in-port", "0",
            "--serial0", f"udpclient:{_LOOPBACK}:{boot.mavlink_port}", "--serial1", "none:",
            "--serial2", "none:",
        ]  # fmt: skip
        return FirmwareProcess(program, arguments, scratch, {})

    @property
    def port(self) -> int:
        """UDP port to which ArduPilot sends its outputs."""
        return int(self._socket.getsockname()[1])

    def has_called(self, timeout_s: float) -> bool:
        """Return True if ArduPilot has sent outputs, after waiting at most `timeout_s` for them."""
        return self._peer is not None or self._await_servos(timeout_s)

    def exchange(self, stamp_us: int, truth: Truth) -> Vector:
        """Send the vehicle's state after a physics step. Return the next motor outputs (4,), 0..1.

        Raises VehicleProcessError if ArduPilot has stopped answering.
        """
        self._socket.sendto(self._state(stamp_us, truth), self._peer)
        if not self._await_servos(ANSWER_LIMIT_S):
            raise VehicleProcessError(f"ArduPilot sent no outputs for {ANSWER_LIMIT_S:g} s")
        return self._throttles

    def close(self) -> None:
        """Close the link."""
        self._socket.close()

    def _await_servos(self, limit_s: float) -> bool:
        """Wait at most `limit_s` for ArduPilot's outputs of a new frame. Return True if received.

        ArduPilot repeats the outputs of a frame that was not answered. Repeated outputs are
        skipped.
        """
        deadline_s = time.monotonic() + limit_s
        while (remaining_s := deadline_s - time.monotonic()) > 0.0:
            self._socket.settimeout(remaining_s)
            try:
                data, peer = self._socket.recvfrom(_SERVOS.size + 1)
            except OSError:  # a timeout, or ArduPilot has ended
                continue
            if len(data) != _SERVOS.size:
                continue
            magic, _rate, frame, *pulses = _SERVOS.unpack(data)
            if magic != _MAGIC or frame == self._frame:
                continue
            self._peer, self._frame = peer, frame
            widths = np.array(pulses[:4], dtype=np.float64)
            self._throttles = np.clip((widths - _LEAST_US) / _SPAN_US, 0.0, 1.0)
            return True
        return False

    def _state(self, stamp_us: int, truth: Truth) -> bytes:
        rates, force = self._sensors.inertial(truth)
        state = {
            "timestamp": stamp_us * 1e-6,
            "imu": {"gyro": rates.tolist(), "accel_body": force.tolist()},
            "position": truth.position_ned_m.tolist(),
            "attitude": truth.euler_rad,
            "velocity": truth.velocity_ned_mps.tolist(),
            "no_time_sync": 1,
        }
        # ArduPilot locates a value by its offset from the key, so no space may follow a colon.
        return b"\n" + json.dumps(state, separators=(",", ":")).encode() + b"\n"
