"""Scripted autopilots that answer as the real ones were observed to; no sockets."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import Any

from mavfi_cli.link.codec import Codec, Message, dialect
from mavfi_cli.link.telemetry import ARDUCOPTER, PX4

DT_S = 0.02
HOME_AMSL_M = 488.0
CLIMB_MPS = 1.5
_ACCEPTED = dialect.MAV_RESULT_ACCEPTED
_REJECTED = dialect.MAV_RESULT_TEMPORARILY_REJECTED
_FAILED = dialect.MAV_RESULT_FAILED
_UNSUPPORTED = dialect.MAV_RESULT_UNSUPPORTED
_GROUND, _AIR, _TAKEOFF, _LANDING = 1, 2, 3, 4


class FakeAutopilot(ABC):
    """What both have in common; a subclass answers commands its own way."""

    autopilot = PX4
    mav_autopilot: int
    streams_unasked: bool

    def __init__(self, *, ready_s: float = 1.0, system: int = 1) -> None:
        self.stamp_s = 0.0
        self.ready_s = ready_s
        self.system = system
        self.mode = next(iter(self.autopilot.modes))
        self.armed = False
        self.landed = _GROUND
        self.position_enu_m = [0.0, 0.0, 0.0]
        self.yaw_enu_rad = math.pi / 2
        self.climb_to_m = 0.0
        self.ground_since_s = 0.0
        self.setpoint: Message | None = None
        self.commands: list[Message] = []  # everything asked of us, in order
        self.setpoints: list[Message] = []
        self.deaf_to: dict[int, int] = {}  # command -> how many of them get lost
        self.silent = False
        self.streams: set[int] = {30, 31, 32, 1, 245} if self.streams_unasked else set()
        self._out: list[Message] = []
        self._wire = (Codec(system, 1), Codec(255, 255))

    def advance(self, inbox: list[Message]) -> list[Message]:
        """One tick: take what the companion sent, move, and tell about it."""
        for message in inbox:
            self._take(message)
        self.stamp_s = round(self.stamp_s + DT_S, 6)
        self._move()
        self._stream()
        out, self._out = self._out, []
        return [] if self.silent else out

    def say(self, message: Message, component: int = 1) -> None:
        """Send a message, through a codec so that it carries our ids."""
        encoder, decoder = self._wire
        encoder.component = component
        self._out += decoder.decode(encoder.encode(message))

    def tell(self, text: str, severity: int = 2, chunk_id: int = 7) -> None:
        """A STATUSTEXT, in chunks where it is long, ending in a tab as PX4's do."""
        raw = text.encode()
        chunks = [raw[i : i + 50] for i in range(0, len(raw) + 1, 50)]
        number = chunk_id if len(chunks) > 1 else 0
        for sequence, chunk in enumerate(chunks):
            self.say(dialect.MAVLink_statustext_message(severity, chunk, number, sequence))

    @property
    def ready(self) -> bool:
        return self.stamp_s >= self.ready_s

    def _take(self, message: Message) -> None:
        kind = message.get_type()
        if kind == "SET_POSITION_TARGET_LOCAL_NED":
            self.setpoints.append(message)
            if message.target_system == self.system:
                self.setpoint = message
        elif kind == "COMMAND_LONG" and message.target_component == 1:
            assert message.target_system == self.system
            self.commands.append(message)
            if self.deaf_to.get(message.command, 0) > 0:
                self.deaf_to[message.command] -= 1
                return
            self._command(message)

    def _ack(self, command: int, result: int) -> None:
        self.say(dialect.MAVLink_command_ack_message(command, result, 0, 0, 1, 191))

    def _command(self, message: Message) -> None:
        if message.command == dialect.MAV_CMD_SET_MESSAGE_INTERVAL:
            self.streams.add(int(message.param1))
            self._ack(message.command, _ACCEPTED)
        elif message.command == dialect.MAV_CMD_REQUEST_MESSAGE:
            self._request(int(message.param1))
        elif message.command == dialect.MAV_CMD_NAV_LAND:
            self.mode = self.autopilot.land_mode
            self._ack(message.command, _ACCEPTED)
        else:
            handler = {176: self._set_mode, 400: self._arm, 22: self._takeoff}.get(message.command)
            if handler is None:
                self._ack(message.command, _UNSUPPORTED)
            else:
                handler(message)

    def _request(self, number: int) -> None:
        if number == 0:
            self._heartbeat()
        elif number == 242 and self.ready:
            self._home()
        self._ack(dialect.MAV_CMD_REQUEST_MESSAGE, _ACCEPTED)

    @abstractmethod
    def _set_mode(self, message: Message) -> None: ...

    @abstractmethod
    def _arm(self, message: Message) -> None: ...

    @abstractmethod
    def _takeoff(self, message: Message) -> None: ...

    def _move(self) -> None:
        height = self.position_enu_m[2]
        if self.mode == self.autopilot.land_mode and self.armed:
            self.position_enu_m[2] = max(0.0, height - CLIMB_MPS * DT_S)
            self.landed = _LANDING if self.position_enu_m[2] > 0 else _GROUND
            if self.landed != _GROUND:
                self.ground_since_s = self.stamp_s
            elif self.stamp_s - self.ground_since_s >= 2.0:
                self.armed = False
        elif self.climb_to_m > 0.0:
            self.position_enu_m[2] = min(self.climb_to_m, height + CLIMB_MPS * DT_S)
            self.landed = _TAKEOFF
            if self.position_enu_m[2] >= self.climb_to_m:
                self.climb_to_m, self.landed = 0.0, _AIR
                self._arrived()
        elif self.mode == self.autopilot.offboard_mode and self.landed == _AIR and self.setpoint:
            s = self.setpoint
            for axis, speed in enumerate((s.vy, s.vx, -s.vz)):
                self.position_enu_m[axis] += speed * DT_S

    def _arrived(self) -> None:  # noqa: B027 (not every autopilot does something)
        """The take-off height is reached."""

    def _due(self, period_s: float) -> bool:
        return round(self.stamp_s / DT_S) % round(period_s / DT_S) == 0

    def _stream(self) -> None:
        if self._due(1.0):
            self._heartbeat()
        if 1 in self.streams and self._due(0.5):
            self._sys_status()
        if 245 in self.streams and self._due(0.2):
            self.say(dialect.MAVLink_extended_sys_state_message(0, self.landed))
        if self.ready and {31, 32} <= self.streams:
            half = (math.pi / 2 - self.yaw_enu_rad) / 2
            ms = round(self.stamp_s * 1e3)
            self.say(
                dialect.MAVLink_attitude_quaternion_message(
                    ms, math.cos(half), 0, 0, math.sin(half), 0, 0, 0
                )
            )
            east, north, up = self.position_enu_m
            self.say(dialect.MAVLink_local_position_ned_message(ms, north, east, -up, 0, 0, 0))

    def _heartbeat(self) -> None:
        base = 1 | (128 if self.armed else 0)
        custom = self.autopilot.modes[self.mode]
        self.say(dialect.MAVLink_heartbeat_message(2, self.mav_autopilot, base, custom, 3, 3))

    def _prearm(self) -> bool:
        return self.ready

    def _sys_status(self) -> None:
        health = 0x320C83F | (1 << 28 if self._prearm() else 0)
        self.say(
            dialect.MAVLink_sys_status_message(
                health, health, health, 0, 12_600, -1, 87, 0, 0, 0, 0, 0, 0
            )
        )

    def _home(self) -> None:
        self.say(
            dialect.MAVLink_home_position_message(
                473977418, 85455939, round(HOME_AMSL_M * 1e3), 0, 0, 0, [1, 0, 0, 0], 0, 0, 0
            )
        )


class FakePX4(FakeAutopilot):
    """Two ACKs for a mode, AMSL take-off, OFFBOARD only with a stream of setpoints."""

    autopilot = PX4
    mav_autopilot = 12
    streams_unasked = True

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.mode = "AUTO.LOITER"
        self.refuse_offboard = False
        self.refuse_arming = ""
        self._pending_mode = ""

    def _set_mode(self, message: Message) -> None:
        self._ack(176, _ACCEPTED)  # before the verdict, whatever it will be
        custom = int(message.param2) << 16 | int(message.param3) << 24
        name = PX4.mode_name(custom)
        if name == "OFFBOARD" and (self.refuse_offboard or self.setpoint is None):
            self._ack(176, _REJECTED)
            self.tell("Switching to Offboard is currently not available\t")
        else:
            self._pending_mode = name
            self._ack(176, _ACCEPTED)

    def _move(self) -> None:
        super()._move()
        if self._pending_mode:
            self.mode, self._pending_mode = self._pending_mode, ""

    def _arm(self, message: Message) -> None:
        if message.param1 == 1.0 and (self.refuse_arming or not self.ready):
            self._ack(400, _REJECTED)
            self.tell(self.refuse_arming or "Arming denied\t")
            return
        self.armed = message.param1 == 1.0
        self._ack(400, _ACCEPTED)
        self.tell("Armed by external command\t", severity=6)

    def _takeoff(self, message: Message) -> None:
        self._ack(22, _ACCEPTED)
        if self.armed:
            self.mode = "AUTO.TAKEOFF"
            self.climb_to_m = message.param7 - HOME_AMSL_M

    def _arrived(self) -> None:
        if self.mode == "AUTO.TAKEOFF":  # a client may have asked for another mode on the way up
            self.mode = "AUTO.LOITER"


class FakeArduCopter(FakeAutopilot):
    """Tells nothing unasked but HEARTBEAT; GUIDED first; take-off height above home."""

    autopilot = ARDUCOPTER
    mav_autopilot = 3
    streams_unasked = False

    def _take(self, message: Message) -> None:
        super()._take(message)
        if message.get_type() == "SET_POSITION_TARGET_LOCAL_NED" and self.mode == "GUIDED":
            self.climb_to_m = 0.0  # GUIDED leaves its take-off for whatever comes
            self.landed = _AIR if self.position_enu_m[2] > 0.0 else _GROUND

    def _set_mode(self, message: Message) -> None:
        self.mode = ARDUCOPTER.mode_name(int(message.param2))
        self._ack(176, _ACCEPTED)

    def _prearm(self) -> bool:
        return self.ready and self.mode == "GUIDED"

    def _arm(self, message: Message) -> None:
        if message.param1 == 1.0 and not self._prearm():
            self._ack(400, _FAILED)
            self.tell("Arm: Need Position Estimate")
            return
        self.armed = message.param1 == 1.0
        self._ack(400, _ACCEPTED)

    def _takeoff(self, message: Message) -> None:
        allowed = self.armed and self.mode == "GUIDED" and self.landed == _GROUND
        self._ack(22, _ACCEPTED if allowed else _FAILED)
        if allowed:
            self.climb_to_m = message.param7
