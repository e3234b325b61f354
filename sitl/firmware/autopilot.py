"""Uses real firmware as the autopilot: runs it and exchanges messages between it and clients."""

from __future__ import annotations

import contextlib
import functools
import math
import os
import signal
import subprocess
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mavfi_cli.core.config import read_toml
from mavfi_cli.core.errors import LinkLost, VehicleProcessError
from mavfi_cli.core.files import ScratchFolder
from mavfi_cli.core.fork_server import die_with
from mavfi_cli.core.processes import Ended
from mavfi_cli.link.codec import (
    SLOW_STREAMS_US,
    STATE_STREAMS,
    Codec,
    dialect,
    text_messages,
)
from mavfi_cli.link.transport import Transport
from sitl.autopilot.commander import Snapshot
from sitl.autopilot.telemetry import Link, Links
from sitl.camera.component import COMPONENT_ID as CAMERA
from sitl.geodesy import Origin
from sitl.vehicle.profile import VehicleProfile
from sitl.vehicle.truth import Truth

_STREAMS_US = {
    **dict.fromkeys(STATE_STREAMS, 20_000.0), **SLOW_STREAMS_US,
    dialect.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED: 100_000.0,
}  # fmt: skip
_FOLLOWING = {  # mode in which each firmware follows a companion
    dialect.MAV_AUTOPILOT_PX4: 6 << 16,  # OFFBOARD
    dialect.MAV_AUTOPILOT_ARDUPILOTMEGA: 4,  # GUIDED
}
_AUTOPILOT: int = dialect.MAV_COMP_ID_AUTOPILOT1
_ECHO_LIMIT_S = 0.2
_SILENCE_US = 60_000_000


class TouchdownWatch:
    """Tells from an autopilot's messages whether a gentle ground contact counts as a landing.

    It does unless the autopilot follows a companion to a place or with a velocity that does not
    lead straight down.
    """

    def __init__(self) -> None:
        self._follows = False
        self._place: tuple[float, ...] = (math.nan,) * 6  # NED, m and m/s
        self._setpoint: tuple[float, ...] = self._place

    @property
    def may_touch_ground(self) -> bool:
        """True if a gentle ground contact now counts as a landing."""
        return not self._follows or Snapshot.touches_down(self._setpoint, self._place[:3])

    def take(self, message: Any) -> None:
        """Take mode, position and setpoint from a message of the autopilot."""
        if isinstance(message, dialect.MAVLink_heartbeat_message):
            self._follows = message.custom_mode == _FOLLOWING.get(message.autopilot)
        elif isinstance(message, dialect.MAVLink_local_position_ned_message):
            self._place = _position_and_velocity(message)
        elif isinstance(message, dialect.MAVLink_position_target_local_ned_message):
            mask = message.type_mask
            self._setpoint = tuple(
                math.nan if mask >> axis & 1 else value
                for axis, value in enumerate(_position_and_velocity(message))
            )


def _position_and_velocity(message: Any) -> tuple[float, ...]:
    """Return the position (3,) and the velocity (3,) of a message, m and m/s."""
    return message.x, message.y, message.z, message.vx, message.vy, message.vz


class FirmwareAutopilot(Links):
    """Makes real firmware at the other end of a MAVLink link the autopilot of a simulation.

    It requests the streams that a flight needs, and sets the firmware's local origin to the
    world's, so that the firmware reports world coordinates. Clients of any preset get all of the
    firmware's messages that the codecs know.

    Args:
        echoes: Whether the firmware answers TIMESYNC while its clock stands still. If so, simulated
            time waits for the firmware to read the clients' frames.
    """

    restart_requested = False  # the firmware handles reboots itself

    def __init__(self, transport: Transport, *, system_id: int = 1, echoes: bool = True) -> None:
        super().__init__()
        self.system_id = system_id
        self.state_stamp_us = -1  # of the newest LOCAL_POSITION_NED; -1 before the first
        self.armed = False  # the motors may turn; the owner sets it
        self.terminated = False  # after a collision
        self._transport = transport
        self._echoes = echoes
        self._codec = Codec(system_id, CAMERA)
        self._touchdown = TouchdownWatch()
        self._to_firmware: list[bytes] = []
        self._prepared = False
        self._heard_us = 0
        self._echo = self._echoed = 0

    # Clients.

    def handle(self, message: Any, _link: Link) -> None:
        """Queue a client's message for the firmware, with the client's own MAVLink ids.

        The next `deliver` sends it.
        """
        codec = self._codec
        codec.system, codec.component = message.get_srcSystem(), message.get_srcComponent()
        self._to_firmware.append(codec.encode(message))
        codec.system, codec.component = self.system_id, CAMERA

    def collect(self, link: Link) -> list[Any]:
        """Return the messages that were queued for a client since the last call."""
        return link.take()

    def forget(self) -> None:
        """Discard all messages that the clients have not collected."""
        for link in self._links:
            link.outbox.clear()

    def terminate(self, text: str) -> None:
        """Stop the motors permanently, and send the clients the reason."""
        if not self.terminated:
            self.terminated = True
            for message in text_messages(dialect.MAV_SEVERITY_CRITICAL, text.encode(), 1):
                self.broadcast(message)

    @property
    def commander(self) -> FirmwareAutopilot:
        """This object itself, because it also holds the motors' state: `armed` and `terminated`."""
        return self

    @property
    def may_touch_ground(self) -> bool:
        """True if a gentle ground contact now counts as a landing."""
        return self._touchdown.may_touch_ground

    # The firmware.

    def deliver(self) -> None:
        """Send the clients' queued messages to the firmware.

        If the firmware echoes, wait for at most 0.2 s until it has read them. Raises
        VehicleProcessError if the firmware has closed its link.
        """
        if not self._to_firmware:
            return
        frames, self._to_firmware = self._to_firmware, []
        if self._echoes:
            self._echo += 1
            frames.append(self._codec.encode(dialect.MAVLink_timesync_message(0, self._echo)))
        self._send(frames)
        deadline_s = time.monotonic() + _ECHO_LIMIT_S
        while self._echoed < self._echo and time.monotonic() < deadline_s:
            self._receive(_ECHO_LIMIT_S)

    def observe(self, stamp_us: int, _truth: Truth) -> None:
        """Handle all messages that the firmware has sent so far.

        `stamp_us` is the simulated time. Raises VehicleProcessError if the firmware has closed its
        link, or has been silent for a minute of simulated time.
        """
        while self._receive(0.0):
            self._heard_us = stamp_us
        if stamp_us - self._heard_us > _SILENCE_US:
            limit_s = _SILENCE_US / 1e6
            raise VehicleProcessError(
                f"the firmware sent no MAVLink for {limit_s:g} s of simulated time"
            )

    def _receive(self, timeout_s: float) -> bool:
        try:
            data = self._transport.receive(timeout_s)
        except LinkLost as error:
            raise VehicleProcessError(str(error)) from None
        for message in self._codec.decode(data, datagram=self._transport.datagram) if data else ():
            self._take(message)
        return bool(data)

    def _take(self, message: Any) -> None:
        number = message.get_msgId()
        if number == dialect.MAVLINK_MSG_ID_TIMESYNC and message.ts1 == self._echo and message.tc1:
            self._echoed = self._echo
            return
        header = message.get_header()
        if header.srcSystem == self.system_id and header.srcComponent == _AUTOPILOT:
            self._touchdown.take(message)
            if number == dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED:
                self.state_stamp_us = message.time_boot_ms * 1000
            elif number == dialect.MAVLINK_MSG_ID_HEARTBEAT and not self._prepared:
                self._prepare()
        self.broadcast(message)

    def _prepare(self) -> None:
        """Request the streams and set the origin, at every heartbeat until positions arrive."""
        self._prepared = self.state_stamp_us >= 0
        place = Origin()
        frames = [
            dialect.MAVLink_set_gps_global_origin_message(
                self.system_id, round(place.latitude_deg * 1e7), round(place.longitude_deg * 1e7),
                round(place.altitude_amsl_m * 1e3),
            )
        ]  # fmt: skip
        frames += [
            dialect.MAVLink_command_long_message(
                self.system_id, dialect.MAV_COMP_ID_AUTOPILOT1,
                dialect.MAV_CMD_SET_MESSAGE_INTERVAL, 0, number, interval_us, 0, 0, 0, 0, 0,
            )
            for number, interval_us in _STREAMS_US.items()
        ]  # fmt: skip
        self._send([self._codec.encode(frame) for frame in frames])

    def _send(self, frames: list[bytes]) -> None:
        try:
            self._transport.send(b"".join(frames))
        except LinkLost as error:
            raise VehicleProcessError(str(error)) from None

    def close(self) -> None:
        """Close the link to the firmware."""
        self._transport.close()


FIXED_PARAMETERS: dict[str, dict[str, float]]
FIXED_PARAMETERS, _ = read_toml(Path(__file__).with_name("parameters.toml"))


@dataclass(frozen=True, slots=True, kw_only=True)
class Boot:
    """The settings of one vehicle with which its firmware is started."""

    profile: VehicleProfile
    system_id: int
    mavlink_port: int  # UDP port to which it sends its MAVLink
    heading_deg: float


_TAIL_LINES, _TAIL_BYTES = 5, 8192  # of output: lines in an error, bytes kept
_CHUNK = 65_536
_DEATH_S = 1.0


class FirmwareProcess:
    """Runs real firmware in a process of its own until `end` is called.

    The firmware runs in its scratch folder, with `environment` added to our environment. Raises
    VehicleProcessError if it cannot be started.
    """

    def __init__(
        self,
        binary: Path,
        arguments: Sequence[str],
        scratch: ScratchFolder,
        environment: Mapping[str, str],
    ) -> None:
        self._binary, self._scratch, folder = binary, scratch, scratch.path
        try:
            self._process = subprocess.Popen(
                [str(binary), *arguments], cwd=folder, env={**os.environ, **environment},
                stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
                start_new_session=True, preexec_fn=functools.partial(die_with, os.getpid()),
            )  # fmt: skip
        except OSError as error:
            self._scratch.close()
            raise VehicleProcessError(
                f"cannot run the firmware {binary}: {error.strerror}"
            ) from None
        self._tail = bytearray()
        self._reader = threading.Thread(target=self._keep_tail, daemon=True)
        self._reader.start()

    @staticmethod
    def program(path: Path) -> Path:
        """Return the absolute path of a program.

        Raises VehicleProcessError if it does not exist or is not executable.
        """
        if not path.is_file():
            raise VehicleProcessError(f"cannot start the firmware, which is not a file: {path}")
        if not os.access(path, os.X_OK):
            raise VehicleProcessError(f"cannot start the firmware, which is not executable: {path}")
        return path.resolve()

    def require_running(self) -> None:
        """Raise VehicleProcessError with the last lines of output if the firmware has ended."""
        if self._process.poll() is not None:
            raise VehicleProcessError(self._state())

    def explain(self, problem: str) -> VehicleProcessError:
        """Return an error with `problem`, the firmware's state and its last lines of output."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(_DEATH_S)  # a link may close before its process has ended
        return VehicleProcessError(f"{problem}; {self._state()}")

    def _state(self) -> str:
        """Describe in one line whether the firmware runs or how it ended, and its last output."""
        code = self._process.poll()
        if code is not None:
            self._reader.join(_DEATH_S)  # with a limit, because a child may hold the pipe
        how = "is running" if code is None else f"ended with code {code}"
        if code is not None and code < 0:
            how = f"was killed by signal {-code}"
        lines = Ended.last_lines(bytes(self._tail), _TAIL_LINES)
        last = f": {' | '.join(lines)}" if lines else ""
        return f"the firmware {self._binary} {how}{last}"

    def _keep_tail(self) -> None:
        """Read the firmware's output until EOF, and keep the last bytes of it."""
        with self._process.stdout as output:  # type: ignore[union-attr]
            while data := os.read(output.fileno(), _CHUNK):
                self._tail[:] = (self._tail + data)[-_TAIL_BYTES:]

    def end(self) -> None:
        """Kill the firmware and all its children, and remove its scratch folder.

        Safe to call more than once.
        """
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        self._scratch.close()
