"""ArduPilot's JSON backend: servo outputs in, the vehicle's state out, over UDP.

ArduPilot sends its outputs and waits for the state, whose timestamp is its clock. It simulates
barometer, magnetometer and GPS itself.
"""

from __future__ import annotations

import json
import socket
import struct
import time
from typing import Any

import numpy as np

from mavfi_cli.core.errors import EndpointError, VehicleProcessError
from mavfi_cli.core.frames import Vector
from sitl.firmware.sensors import Sensors
from sitl.vehicle.vehicle import Truth

PORT = 9002
_LOOPBACK = "127.0.0.1"
STEP_S = 0.0025  # ArduCopter's main loop runs at 400 Hz
_SERVOS = struct.Struct("<HHI16H")
_MAGIC = 18458
_LEAST_US, _SPAN_US = 1000.0, 1000.0
ANSWER_LIMIT_S = 10.0


class ArduPilotLink:
    """One ArduPilot on the JSON backend.

    Args:
        sensors: Sensors of the vehicle.
        port: UDP port that ArduPilot sends to; 0 for any.

    Raises:
        EndpointError: The port cannot be opened.
    """

    step_s = STEP_S
    settle_s = 0.0  # its boot takes the same simulated time in every flight

    def __init__(self, sensors: Sensors, port: int = PORT) -> None:
        self._sensors = sensors
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind((_LOOPBACK, port))
        except OSError as error:
            self._socket.close()
            raise EndpointError(f"udp port {port}", error.strerror or str(error)) from None
        self._peer: Any = None
        self._frame = -1
        self._throttles = np.zeros(4)

    @property
    def port(self) -> int:
        """Port that ArduPilot sends to."""
        return int(self._socket.getsockname()[1])

    def heard(self, timeout_s: float) -> bool:
        """Return True once ArduPilot has sent its outputs, waiting at most `timeout_s`."""
        return self._peer is not None or self._await_servos(timeout_s)

    def exchange(self, stamp_us: int, truth: Truth) -> Vector:
        """Send the state of a step and return the motor outputs (4,) in 0..1.

        Raises:
            VehicleProcessError: ArduPilot has stopped answering.
        """
        self._socket.sendto(self._state(stamp_us, truth), self._peer)
        if not self._await_servos(ANSWER_LIMIT_S):
            raise VehicleProcessError(f"ArduPilot gave no outputs for {ANSWER_LIMIT_S:g} s")
        return self._throttles

    def close(self) -> None:
        """Close the link."""
        self._socket.close()

    def _await_servos(self, limit_s: float) -> bool:
        """Take the outputs of the next frame. ArduPilot repeats a frame that has no answer."""
        deadline_s = time.monotonic() + limit_s
        while (remaining_s := deadline_s - time.monotonic()) > 0.0:
            self._socket.settimeout(remaining_s)
            try:
                data, peer = self._socket.recvfrom(_SERVOS.size + 1)
            except OSError:  # the time is over, or ArduPilot has ended
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
        # ArduPilot finds values by their distance from the key: no space after a colon.
        return b"\n" + json.dumps(state, separators=(",", ":")).encode() + b"\n"
