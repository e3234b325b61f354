"""Keeps the newest telemetry of one autopilot, updated message by message.

Autopilots differ in mode numbers and take-off procedure. Sources: PX4's px4_custom_mode.h (main
mode in bits 16..23, sub mode in bits 24..31) and ArduCopter's mode numbers. Both were checked
against messages from PX4 1.17 and ArduCopter 4.5.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mavfi_cli.core.config import read_toml
from mavfi_cli.core.errors import printable
from mavfi_cli.core.frames import (
    FARTHEST_M,
    FASTEST_MPS,
    dot,
    flu_enu_from_frd_ned,
    is_within,
    norm,
    quaternion_from_euler,
    yaw_from_quaternion,
)
from mavfi_cli.core.types import FloatArray, VehicleState
from mavfi_cli.link.codec import CHUNK_LENGTH, Message, dialect
from mavfi_cli.link.endpoint import TWO_AUTOPILOTS


@dataclass(frozen=True, slots=True, kw_only=True)
class _AutopilotProfile:
    """Modes and command conventions of one autopilot, from a table in `autopilots.toml`."""

    name: str
    modes: dict[str, int]  # mode name -> HEARTBEAT.custom_mode
    offboard_mode: str  # mode in which it follows our setpoints
    land_mode: str
    hold_mode: str  # mode in which it holds its position without setpoints
    arming_modes: list[str]  # modes that allow arming; the session requests the first
    takeoff_amsl: bool  # NAV_TAKEOFF altitude is above sea level instead of above home
    unused: float  # value of an unused command parameter
    early_setpoints: bool  # requires setpoints before offboard; False: they would abort take-off

    def mode_name(self, custom_mode: int) -> str:
        """Return the name of a HEARTBEAT.custom_mode, or "mode N" if it is unknown."""
        for name, number in self.modes.items():
            if number == custom_mode:
                return name
        return f"mode {custom_mode}"

    def mode_parameters(self, name: str) -> tuple[float, float]:
        """Return parameters 2 and 3 of MAV_CMD_DO_SET_MODE for a mode named in `modes`."""
        number = self.modes[name]
        if self is PX4:
            return float(number >> 16 & 0xFF), float(number >> 24)
        return float(number), 0.0


_PROFILES, _ = read_toml(Path(__file__).with_name("autopilots.toml"))
PX4, ARDUCOPTER = (_AutopilotProfile(**_PROFILES[name]) for name in ("px4", "ardupilot"))

_PROFILES = {dialect.MAV_AUTOPILOT_PX4: PX4, dialect.MAV_AUTOPILOT_ARDUPILOTMEGA: ARDUCOPTER}
_COPTERS = (
    dialect.MAV_TYPE_QUADROTOR, dialect.MAV_TYPE_COAXIAL, dialect.MAV_TYPE_HELICOPTER,
    dialect.MAV_TYPE_HEXAROTOR, dialect.MAV_TYPE_OCTOROTOR, dialect.MAV_TYPE_TRICOPTER,
    dialect.MAV_TYPE_DODECAROTOR, dialect.MAV_TYPE_DECAROTOR, dialect.MAV_TYPE_GENERIC_MULTIROTOR,
)  # fmt: skip
AUTOPILOT: int = dialect.MAV_COMP_ID_AUTOPILOT1
CAMERA: int = dialect.MAV_COMP_ID_CAMERA
_KEPT = 512
_REORDERED_MS = 1000  # a stamp that lags by less is a late packet; otherwise the clock restarted


class _StateHistory:
    """The newest vehicle states in stamp order. At 2 * _KEPT states, the older half is dropped."""

    def __init__(self) -> None:
        self._stamps_ms: list[int] = []
        self._states: list[VehicleState] = []

    def add(self, state: VehicleState) -> bool:
        """Append a state and return True, or return False if the state is late or repeated.

        A restart of the autopilot's clock drops all earlier states.
        """
        stamp_ms = round(state.stamp_s * 1e3)
        if self._stamps_ms and stamp_ms <= self._stamps_ms[-1]:
            if stamp_ms > self._stamps_ms[-1] - _REORDERED_MS:
                return False
            self._stamps_ms.clear()
            self._states.clear()
        self._stamps_ms.append(stamp_ms)
        self._states.append(state)
        if len(self._states) >= 2 * _KEPT:
            del self._stamps_ms[:-_KEPT]
            del self._states[:-_KEPT]
        return True

    def at(self, stamp_s: float) -> VehicleState | None:
        """Return the state at a stamp, interpolated if needed, or None outside the history."""
        stamp_ms = round(stamp_s * 1e3)
        index = bisect_left(self._stamps_ms, stamp_ms)
        if index == len(self._stamps_ms):
            return None
        if self._stamps_ms[index] == stamp_ms:
            return self._states[index]
        if index == 0:
            return None
        return _between(self._states[index - 1], self._states[index], stamp_s)


def _between(before: VehicleState, after: VehicleState, stamp_s: float) -> VehicleState:
    """Return the vehicle state at `stamp_s`, interpolated between two states.

    Position and velocity are interpolated linearly, the quaternion by nlerp along the shorter arc.
    """
    share = (stamp_s - before.stamp_s) / (after.stamp_s - before.stamp_s)
    sign = -1.0 if dot(before.quaternion, after.quaternion) < 0.0 else 1.0
    quaternion = (1.0 - share) * before.quaternion + share * sign * after.quaternion
    length = norm(quaternion)
    quaternion = quaternion / length if length > 0.0 else before.quaternion
    return VehicleState(
        stamp_s=stamp_s,
        position_enu_m=(1.0 - share) * before.position_enu_m + share * after.position_enu_m,
        velocity_enu_mps=(1.0 - share) * before.velocity_enu_mps + share * after.velocity_enu_mps,
        quaternion=quaternion,
        yaw_rad=yaw_from_quaternion(quaternion),
    )


_PREARM = dialect.MAV_SYS_STATUS_PREARM_CHECK
_IN_AIR = (
    dialect.MAV_LANDED_STATE_IN_AIR,
    dialect.MAV_LANDED_STATE_TAKEOFF,
    dialect.MAV_LANDED_STATE_LANDING,
)


_MAX_OPEN = 16
_MAX_TEXTS = 1000
_PATIENCE_S = 1.0  # maximum wait for missing chunks
_GAP = "[...]"
_LONGEST = 1000  # characters of a text


class _Text(NamedTuple):
    """A finished status text of a component, in which _GAP stands for missing chunks."""

    severity: int  # MAV_SEVERITY, 0 emergency .. 7 debug
    text: str


class _Open(NamedTuple):
    """An unfinished status text, with the chunks that have arrived, keyed by number."""

    severity: int
    started_s: float
    chunks: dict[int, str]


class _TextCollector:
    """Assembles status texts from their chunks, and keeps the newest 1000 finished texts.

    `total` counts all finished texts.
    """

    def __init__(self) -> None:
        self.texts: deque[_Text] = deque(maxlen=_MAX_TEXTS)
        self.total = 0
        self.open: dict[tuple[int, int, int], _Open] = {}

    def since(self, total: int) -> list[_Text]:
        """Return the kept texts that were finished after the first `total` texts, oldest first."""
        if total == self.total:
            return []
        fresh = min(self.total - total, len(self.texts))
        return list(self.texts)[len(self.texts) - fresh :]

    def add(self, message: Message, stamp_s: float) -> list[_Text]:
        """Handle a STATUSTEXT. Return the texts that it finishes."""
        if message.id == 0:
            return [self._emit(message.severity, message.text)]
        done = []
        key = (message.get_srcSystem(), message.get_srcComponent(), message.id)
        if key not in self.open:
            if len(self.open) >= _MAX_OPEN:
                done.append(self._finish(next(iter(self.open))))
            self.open[key] = _Open(message.severity, stamp_s, {})
        chunks = self.open[key].chunks
        chunks[message.chunk_seq] = message.text
        last = max(chunks)
        if len(chunks[last]) < CHUNK_LENGTH and len(chunks) == last + 1:
            done.append(self._finish(key))
        return done

    def expire(self, stamp_s: float, patience_s: float = _PATIENCE_S) -> list[_Text]:
        """Finish the incomplete texts that began at least `patience_s` ago, and return them.

        Their missing chunks are marked as gaps.
        """
        late = [k for k, o in self.open.items() if stamp_s - o.started_s >= patience_s]
        return [self._finish(key) for key in late]

    def _finish(self, key: tuple[int, int, int]) -> _Text:
        part = self.open.pop(key)
        text, expected = "", 0
        for index, chunk in sorted(part.chunks.items()):
            text += chunk if index == expected else _GAP + chunk
            expected = index + 1
        if len(part.chunks[expected - 1]) >= CHUNK_LENGTH:
            text += _GAP
        return self._emit(part.severity, text)

    def _emit(self, severity: int, text: str) -> _Text:
        self.total += 1
        self.texts.append(_Text(severity, printable(text.strip())[:_LONGEST]))
        return self.texts[-1]


class Telemetry:
    """Newest telemetry of one autopilot: the first supported one that sends a HEARTBEAT.

    An autopilot is component 1 of any system. A HEARTBEAT of another autopilot sets `unfit`. All
    other messages of other senders are ignored.
    """

    def __init__(self) -> None:
        self.now_s = 0.0  # receive time of handled messages, set by the owner
        self.system = 0  # id of the autopilot; 0 before its first message
        self.unfit = ""  # why an autopilot on the link cannot be used
        self.autopilot: _AutopilotProfile = PX4
        self.state: VehicleState | None = None  # None before position and attitude are known
        self.origin_enu_m: FloatArray | None = (
            None  # origin of its positions (3,); None: the world's origin
        )
        self.armed = False
        self.mode = ""  # name of the flight mode; "" before the first HEARTBEAT
        self.landed_state: int = dialect.MAV_LANDED_STATE_UNDEFINED  # unknown values are ignored
        self.ready = False  # the pre-arm checks pass
        self.amsl_m: float | None = None  # altitudes above sea level: current, and at home
        self.home_amsl_m: float | None = None
        self.battery_remaining: float | None = None  # charge, 0..1
        self.battery_voltage_v: float | None = None
        self.texts = _TextCollector()
        self.collision_text: str | None = None  # the referee's report of a collision
        self.history = _StateHistory()
        self._quaternion: FloatArray | None = None  # body FLU -> ENU

    @property
    def heard(self) -> bool:
        """True once an autopilot has sent a HEARTBEAT."""
        return self.system != 0

    @property
    def in_air(self) -> bool:
        """True if the autopilot reports that it is taking off, flying or landing."""
        return self.landed_state in _IN_AIR

    def handle(self, message: Message) -> None:
        """Handle a message from the autopilot. Ignore messages from other senders."""
        handler = _HANDLERS.get(type(message).id)
        if handler is None:
            return
        if isinstance(message, dialect.MAVLink_heartbeat_message):
            self._adopt(message)
        if self.is_from(message, AUTOPILOT):
            handler(self, message)

    def is_from(self, message: Message, component: int) -> bool:
        """Return True if the message comes from this component of the autopilot's system."""
        header = message.get_header()
        return bool(header.srcComponent == component and header.srcSystem == self.system != 0)

    def _adopt(self, message: Message) -> None:
        """Adopt the sender of a HEARTBEAT if it is the first supported autopilot.

        Set `unfit` if it is a second autopilot, or one that is not supported.
        """
        system, profile = message.get_srcSystem(), _PROFILES.get(message.autopilot)
        if message.get_srcComponent() != AUTOPILOT or system == self.system:
            return
        if message.autopilot == dialect.MAV_AUTOPILOT_INVALID:
            return
        if self.heard:
            self.unfit = f"two autopilots are on this link, systems {self.system} and {system}"
        elif profile is None or message.type not in _COPTERS:
            self.unfit = (
                f"system {system} must be PX4 or ArduPilot with a multicopter, got "
                f"{_name('MAV_AUTOPILOT', message.autopilot)} with "
                f"{_name('MAV_TYPE', message.type)}"
            )
        else:
            self.system, self.autopilot = system, profile

    def _heartbeat(self, message: Message) -> None:
        self.armed = bool(message.base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED)
        self.mode = self.autopilot.mode_name(message.custom_mode)

    def _local_position(self, message: Message) -> None:
        position = (message.y, message.x, -message.z)
        velocity = (message.vy, message.vx, -message.vz)
        if not (is_within(FARTHEST_M, position) and is_within(FASTEST_MPS, velocity)):
            return
        if self._quaternion is None:
            return
        place = np.array(position, dtype=np.float64)
        if self.origin_enu_m is not None:
            place += self.origin_enu_m
        state = VehicleState(
            stamp_s=message.time_boot_ms / 1e3,
            position_enu_m=place,
            velocity_enu_mps=np.array(velocity, dtype=np.float64),
            quaternion=self._quaternion,
            yaw_rad=yaw_from_quaternion(self._quaternion.tolist()),
        )
        if self.history.add(state):
            self.state = state

    def _attitude(self, message: Message) -> None:
        angles = (message.roll, message.pitch, message.yaw)
        if all(math.isfinite(angle) for angle in angles):
            self._attitude_from(*quaternion_from_euler(*angles).tolist())

    def _attitude_from(self, w: float, x: float, y: float, z: float) -> None:
        """Normalize and store a body-FRD-to-NED quaternion if its length is in (0.5, 2)."""
        norm = math.sqrt(w * w + x * x + y * y + z * z)
        if 0.5 < norm < 2.0:
            self._quaternion = flu_enu_from_frd_ned((w / norm, x / norm, y / norm, z / norm))

    def _sys_status(self, message: Message) -> None:
        self.ready = bool(message.onboard_control_sensors_health & _PREARM)
        if message.voltage_battery != 0xFFFF:
            self.battery_voltage_v = message.voltage_battery / 1e3
        if 0 <= message.battery_remaining <= 100:
            self.battery_remaining = message.battery_remaining / 100.0

    def _extended_sys_state(self, message: Message) -> None:
        if message.landed_state <= dialect.MAV_LANDED_STATE_LANDING:
            self.landed_state = message.landed_state

    def _home(self, message: Message) -> None:
        self.home_amsl_m = message.altitude / 1e3

    def _global_position(self, message: Message) -> None:
        self.amsl_m = message.alt / 1e3
        if self.home_amsl_m is None:
            self.home_amsl_m = (message.alt - message.relative_alt) / 1e3

    def move_origin(self, origin_enu_m: FloatArray) -> None:
        """Set the origin (3,) of the autopilot's positions in the world frame (ENU), in metres.

        A new origin drops all earlier states. An origin with a coordinate beyond FARTHEST_M is
        ignored.
        """
        if not is_within(FARTHEST_M, origin_enu_m):
            return
        before = np.zeros(3) if self.origin_enu_m is None else self.origin_enu_m
        if np.array_equal(origin_enu_m, before):
            return
        self.origin_enu_m = origin_enu_m
        self.state, self.history = None, _StateHistory()

    def take_text(self, message: Message) -> None:
        """Handle a STATUSTEXT from the autopilot or another component of its system."""
        self._look_for_verdict(self.texts.add(message, self.now_s))

    def expire(self) -> None:
        """Finish the status texts whose missing chunks are overdue."""
        if self.texts.open:
            self._look_for_verdict(self.texts.expire(self.now_s))

    def _look_for_verdict(self, texts: Iterable[_Text]) -> None:
        for text in texts:
            if self.collision_text is None and text.text.startswith("Collision"):
                self.collision_text = text.text
            elif text.text.startswith(TWO_AUTOPILOTS):
                self.unfit = text.text


def _name(enum: str, number: int) -> str:
    entry = dialect.enums[enum].get(number)
    return f"{enum} {number}" if entry is None else str(entry.name)


_HANDLERS: dict[int, Callable[[Telemetry, Message], None]] = {
    dialect.MAVLINK_MSG_ID_HEARTBEAT: Telemetry._heartbeat,
    dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED: Telemetry._local_position,
    dialect.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: lambda telemetry, message: telemetry._attitude_from(
        message.q1, message.q2, message.q3, message.q4
    ),
    dialect.MAVLINK_MSG_ID_ATTITUDE: Telemetry._attitude,
    dialect.MAVLINK_MSG_ID_SYS_STATUS: Telemetry._sys_status,
    dialect.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: Telemetry._extended_sys_state,
    dialect.MAVLINK_MSG_ID_HOME_POSITION: Telemetry._home,
    dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: Telemetry._global_position,
    dialect.MAVLINK_MSG_ID_STATUSTEXT: Telemetry.take_text,
}
