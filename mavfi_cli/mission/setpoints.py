"""Converts a companion's setpoints, and the states they are based on, to detector samples.

A detector has 13 inputs (`detect.preprocess`). The 7 of the waypoint take the vehicle's state: its
position, yaw and velocity. The 4 of the command take the setpoint: its yaw, and the displacement
that it requests within 1 s,

    d = (p_target - p) + v_target * 1 s + a_target / 2 * (1 s)^2,

in ENU, with each term only if the setpoint has it. For a velocity setpoint d is thus its velocity
times 1 s. For SET_ATTITUDE_TARGET d is (roll, pitch, thrust), or (roll rate, pitch rate, thrust)
and a yaw rate in place of the yaw if the message gives body rates without an attitude. The 2 inputs
of the collision check are not used.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from mavfi_cli.core.types import Command, Trajectory, VehicleState
from mavfi_cli.detect.offline import FlightSamples
from mavfi_cli.link.codec import Message, dialect
from mavfi_cli.link.peers import Peer
from mavfi_cli.link.telemetry import ARDUCOPTER, AUTOPILOT, Telemetry
from mavfi_cli.link.tlog import EPOCH_UNIX_S, tlog_messages

_LOCAL = dialect.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED
_GLOBAL = dialect.MAVLINK_MSG_ID_SET_POSITION_TARGET_GLOBAL_INT
_ATTITUDE = dialect.MAVLINK_MSG_ID_SET_ATTITUDE_TARGET
SETPOINTS = (_LOCAL, _GLOBAL, _ATTITUDE)
"""Ids of the messages that a gate judges."""

_BODY = (dialect.MAV_FRAME_BODY_NED, dialect.MAV_FRAME_BODY_OFFSET_NED)
_OFFSET = (*_BODY, dialect.MAV_FRAME_LOCAL_OFFSET_NED)
_RELATIVE = (  # the ground is level with home
    dialect.MAV_FRAME_GLOBAL_RELATIVE_ALT, dialect.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT,
    dialect.MAV_FRAME_GLOBAL_TERRAIN_ALT, dialect.MAV_FRAME_GLOBAL_TERRAIN_ALT_INT,
)  # fmt: skip
_NO_POSITION, _NO_YAW, _NO_YAW_RATE = 0x7, 0x400, 0x800  # bits of a setpoint's type_mask
_NO_THRUST, _NO_ATTITUDE = 0x40, 0x80  # bits of the type_mask of SET_ATTITUDE_TARGET
_DEGREE_M = 1e-7 * 111_319.5  # one unit of lat_int


_MOST_COMMANDERS = 100


class SetpointView:
    """Converts setpoints to samples, relative to the autopilot's newest state."""

    class Commanders:
        """The senders of setpoints on a link, of which a vehicle should have only one."""

        def __init__(self) -> None:
            self._peers: dict[tuple[int, int], list[Peer]] = {}  # the newest two of each sender
            self._shared: set[tuple[int, int]] = set()

        def another(self, setpoint: Message, peer: Peer | None) -> str:
            """Return a text if a setpoint comes from a further sender, otherwise an empty string.

            Two peers with the same system and component are two senders once the first sends again
            after the second. Until then, the second may be the first, started again. At most 100
            senders are known, so a flood of senders does not cause a flood of texts.

            Args:
                peer: Peer that has sent the setpoint; None if it is not known.
            """
            sender = setpoint.get_srcSystem(), setpoint.get_srcComponent()
            is_new = sender not in self._peers
            if is_new and len(self._peers) >= _MOST_COMMANDERS:
                return ""
            peers = self._peers.setdefault(sender, [])
            shares = peer in peers[:-1] and sender not in self._shared
            if shares:
                self._shared.add(sender)
            elif peer is not None and peer not in peers:
                self._peers[sender] = [*peers[-1:], peer]
            if not (shares or (is_new and len(self._peers) > 1)):
                return ""
            also = "also " if shares else ""
            return f"another commander, {also}{sender[0]}/{sender[1]}, sends setpoints"

    def __init__(self) -> None:
        self.telemetry = Telemetry()
        self._global: Message | None = None
        self._state: VehicleState | None = None
        self._trajectory: Trajectory | None = None

    def hear(self, message: Message) -> None:
        """Update the state from a message of the autopilot."""
        if not isinstance(message, dialect.MAVLink_unknown):
            self.telemetry.handle(message)
        if message.get_msgId() == dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT:
            self._global = message if self.telemetry.is_from(message, AUTOPILOT) else self._global

    def sample(self, setpoint: Message) -> tuple[Trajectory | None, int, Command]:
        """Convert a setpoint to a detector sample: the arguments of `Gate.judge_tick`.

        The trajectory is None if the autopilot has not sent its state yet.
        """
        state = self.telemetry.state
        if state is not None and state is not self._state:
            x, y, z = state.position_enu_m.tolist()
            row = [x, y, z, state.yaw_rad, *state.velocity_enu_mps.tolist(), 0.0, 0.0, 0.0]
            self._trajectory = Trajectory(
                stamp_s=state.stamp_s, waypoints=np.array([row]), durations_s=np.ones(1),
                trajectory_seq=0, future_collision_seq=0,
            )  # fmt: skip
        self._state = state
        return self._trajectory, 0, command_of(setpoint, self.telemetry, self._global)


def command_of(
    setpoint: Message, telemetry: Telemetry, global_position: Message | None = None
) -> Command:
    """Return a command with the yaw and the displacement within 1 s that a setpoint requests.

    The command holds the displacement as its velocity, in ENU. For SET_ATTITUDE_TARGET, it holds
    (roll, pitch, thrust) there instead, or body rates (see the module). In a body frame, ArduCopter
    takes the yaw as relative and positions as offsets; PX4 takes the yaw as absolute and ignores
    positions.

    Args:
        telemetry: Newest telemetry of the autopilot, with the vehicle's state.
        global_position: The vehicle's newest GLOBAL_POSITION_INT, needed for setpoints with
            latitude and longitude.
    """
    state, offsets = telemetry.state, telemetry.autopilot is ARDUCOPTER
    yaw_rad = 0.0 if state is None else state.yaw_rad
    stamp_s = 0.0 if state is None else state.stamp_s
    if setpoint.get_msgId() == _ATTITUDE:
        roll, pitch, yaw, thrust = _attitude_of(setpoint)
        attitude = np.array([roll, pitch, thrust])
        return Command(stamp_s=stamp_s, velocity_enu_mps=attitude, yaw_rad=yaw)
    mask, body = setpoint.type_mask, setpoint.coordinate_frame in _BODY
    mask |= _NO_POSITION if body and not offsets else 0
    move = [0.0, 0.0, 0.0]  # north, east, down; in a body frame: forward, right, down
    targets = _position_errors(setpoint, state, global_position)
    velocity, pull = (
        (setpoint.vx, setpoint.vy, setpoint.vz),
        (setpoint.afx, setpoint.afy, setpoint.afz),
    )
    for axis in range(3):
        for first, part in ((1, targets[axis]), (8, velocity[axis]), (64, 0.5 * pull[axis])):
            if not mask & first << axis:
                move[axis] += part
    forward, right, down = move
    if body:
        heading_rad = 0.5 * math.pi - yaw_rad
        cosine, sine = math.cos(heading_rad), math.sin(heading_rad)
        forward, right = cosine * forward - sine * right, sine * forward + cosine * right
    if not mask & _NO_YAW:
        new_rad = (yaw_rad if body and offsets else 0.5 * math.pi) - setpoint.yaw
        yaw_rad = math.remainder(new_rad, math.tau) if math.isfinite(new_rad) else new_rad
    elif not mask & _NO_YAW_RATE:
        yaw_rad -= setpoint.yaw_rate
    return Command(
        stamp_s=stamp_s, velocity_enu_mps=np.array([right, forward, -down]), yaw_rad=yaw_rad
    )


def _position_errors(
    setpoint: Message, state: VehicleState | None, here: Message | None
) -> tuple[float, float, float]:
    """Return the displacement from the vehicle to the target, in metres.

    Its axes are those of the setpoint's frame. Without a global position, the displacement to a
    target with latitude and longitude is 0.
    """
    if setpoint.get_msgId() == _GLOBAL:
        if here is None:
            return 0.0, 0.0, 0.0
        frame = setpoint.coordinate_frame
        up_m = (here.relative_alt if frame in _RELATIVE else here.alt) / 1e3
        north_m = (setpoint.lat_int - here.lat) * _DEGREE_M
        east_m = (setpoint.lon_int - here.lon) * _DEGREE_M * math.cos(math.radians(1e-7 * here.lat))
        return north_m, east_m, up_m - setpoint.alt
    if setpoint.coordinate_frame in _OFFSET or state is None:
        return setpoint.x, setpoint.y, setpoint.z
    east_m, north_m, up_m = state.position_enu_m.tolist()
    return setpoint.x - north_m, setpoint.y - east_m, setpoint.z + up_m


def _attitude_of(setpoint: Message) -> tuple[float, float, float, float]:
    """Return the roll, pitch and yaw of a SET_ATTITUDE_TARGET in radians, and its thrust.

    Without an attitude they are the body rates in rad/s. Fields that the mask ignores are 0. A yaw
    rate beside an attitude adds what it turns in 1 s.
    """
    mask = setpoint.type_mask
    rates = [
        0.0 if mask & bit else rate
        for bit, rate in (
            (1, setpoint.body_roll_rate), (2, setpoint.body_pitch_rate),
            (4, setpoint.body_yaw_rate),
        )
    ]  # fmt: skip
    thrust = 0.0 if mask & _NO_THRUST else setpoint.thrust
    if mask & _NO_ATTITUDE:
        return rates[0], rates[1], rates[2], thrust
    roll, pitch, yaw = _euler(setpoint.q)
    return roll, pitch, yaw + rates[2], thrust


def _euler(q: list[float]) -> tuple[float, float, float]:
    """Return the roll, pitch and yaw of a quaternion (w, x, y, z), in radians.

    They are NaN if the quaternion is not finite.
    """
    if not all(map(math.isfinite, q)):
        return math.nan, math.nan, math.nan
    w, x, y, z = (value / (math.hypot(*q) or 1.0) for value in q)
    return (
        math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)),
        math.asin(max(-1.0, min(1.0, 2.0 * (w * y - z * x)))),
        math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)),
    )


def samples_of_tlog(path: Path, world: str, seed: int) -> FlightSamples:
    """Convert the setpoints in the .tlog file of a fault-free flight to detector samples.

    Args:
        world, seed: World and seed that identify the flight in its data set.

    Raises:
        RecordError: The file cannot be read.
    """
    return FlightSamples.of_ticks(_ticks(path), world, seed)


def _ticks(path: Path) -> Iterator[tuple[float, Trajectory | None, Command]]:
    view = SetpointView()
    for unix_s, message in tlog_messages(path):
        if message.get_msgId() in SETPOINTS:
            trajectory, _, command = view.sample(message)
            yield unix_s - EPOCH_UNIX_S, trajectory, command
        else:
            view.hear(message)
