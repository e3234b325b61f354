"""The autopilot: runs the active mode, collects telemetry and decides whose commands to obey."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from mavfi_cli.core.frames import Vector
from mavfi_cli.link.codec import dialect, text_messages
from sitl.autopilot.commander import (
    GPS_FIX_US,
    Commander,
    FlightMode,
    Result,
    Severity,
    Snapshot,
    no_setpoint,
)
from sitl.autopilot.flight_modes import begin, climbs
from sitl.autopilot.parameters import TYPE_REAL32, Parameters
from sitl.autopilot.telemetry import Link, Links
from sitl.geodesy import Origin
from sitl.vehicle.cascade import SP_THRUST
from sitl.vehicle.truth import Truth

COMPONENT = 1
_PARAMETERS_A_TICK = 20  # about 1000 per second, as in PX4
_TEXTS_A_TICK = 10  # further texts are dropped, so that bad messages cannot cause a flood of them


class Autopilot(Links):
    """A PX4-like autopilot without sockets or clock.

    At every stamp, call `observe` with the vehicle's state, `collect` for the messages of every
    link, `services.handle` for every received message, then `fly`. The snapshot's setpoint and
    `motors_on` hold until the next stamp.

    Args:
        truth: Vehicle state before the first `observe`.
        trusted: Ids of the MAVLink systems that may send commands. If empty, all systems may.

    Attributes:
        restart_requested: True once a client has requested a reboot, which the owner performs.
    """

    def __init__(self, truth: Truth, *, system_id: int = 1, trusted: Sequence[int] = ()) -> None:
        super().__init__()
        self.system_id = system_id
        self.parameters = Parameters(system_id)
        self.commander = Commander(self.parameters)
        self.authority = _Authority(trusted, self.commander.queue_text)
        self.restart_requested = False
        self.snapshot = Snapshot(
            commander=self.commander,
            parameters=self.parameters,
            origin=Origin(),
            truth=truth,
            home_ned_m=np.array(truth.position_ned_m),
        )
        self._flown: FlightMode | None = None
        self._guidance = begin(FlightMode.LOITER, self.snapshot)
        self._text_id = 0
        self._texts_left = _TEXTS_A_TICK

    # Links.

    def collect(self, link: Link) -> list[Any]:
        """Return all messages due on a link at the newest stamp: queued answers, then streams."""
        for _ in range(min(_PARAMETERS_A_TICK, len(link.parameters_left))):
            link.send(self.parameters.message(link.parameters_left.popleft()))
        return link.take() + link.due(self.snapshot)

    def collect_between(self, link: Link, stamp_us: int) -> list[Any]:
        """Return the messages due on a link's fast streams at a stamp between two ticks."""
        tick_us, self.snapshot.stamp_us = self.snapshot.stamp_us, stamp_us
        messages = link.due(self.snapshot, between_ticks=True)
        self.snapshot.stamp_us = tick_us
        return messages

    # Requests of clients.

    def enter_mode(
        self,
        mode: FlightMode | None,
        *,
        takeoff_down_m: float = math.nan,
        hold: tuple[Vector, float] | None = None,
    ) -> Result:
        """Change the mode on a user's request, and return the result to acknowledge.

        Entering the current mode restarts it. None stands for an unknown mode, which is rejected. A
        disarmed vehicle takes off once it is armed. For `takeoff_down_m` and `hold`, see
        `Snapshot`.
        """
        result = self.commander.request_mode(mode)
        if result is Result.ACCEPTED:
            self._flown, self.snapshot.hold = None, hold
            if mode is FlightMode.TAKEOFF:
                self.snapshot.takeoff_down_m = takeoff_down_m
        return result

    def set_home(self, place_ned_m: Vector) -> None:
        """Set the home position (3,), and make its messages due on every link."""
        self.snapshot.home_ned_m = place_ned_m
        for link in self._links:
            link.hasten(dialect.MAVLINK_MSG_ID_HOME_POSITION, self.snapshot.stamp_us)
            link.hasten(dialect.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN, self.snapshot.stamp_us)

    def set_parameter(self, name: str, value: float) -> None:
        """Change a REAL32 parameter by its name, and broadcast the new value to all clients."""
        index = self.parameters.index(name)
        assert index is not None
        self.parameters.write(name, value, TYPE_REAL32)
        self.broadcast(self.parameters.message(index))

    # Updates over time.

    def observe(self, stamp_us: int, truth: Truth) -> None:
        """Advance to a stamp with the vehicle's state there, and update the commander."""
        now = self.snapshot
        self._texts_left = _TEXTS_A_TICK
        now.elapsed_s = (stamp_us - now.stamp_us) * 1e-6
        has_fix_now = stamp_us >= GPS_FIX_US > now.stamp_us
        now.stamp_us, now.truth = stamp_us, truth
        if has_fix_now:
            self.set_home(np.array(truth.position_ned_m))
        now.consumed_mah += max(truth.battery_current_a, 0.0) * now.elapsed_s / 3.6
        wants_up = now.motors_on and climbs(now.setpoint, truth)
        self.commander.update(stamp_us, truth, wants_up=wants_up)
        self.flush_texts()

    @property
    def may_touch_ground(self) -> bool:
        """True if a gentle ground contact now counts as a landing."""
        if self.commander.mode is not FlightMode.OFFBOARD:
            return True
        now = self.snapshot
        return now.touches_down(now.setpoint[:6].tolist(), now.truth.position_ned_m.tolist())

    def fly(self) -> None:
        """Run the active mode: set the setpoint and the motors until the next stamp."""
        commander, now = self.commander, self.snapshot
        out = no_setpoint()
        if not commander.armed:
            self._flown = None
            now.setpoint, now.motors_on = out, False
            return
        if commander.mode is not self._flown:
            self._guidance = begin(commander.mode, now)
            self._flown = commander.mode
        self._guidance(now, out)
        ready = now.spooled_up or not math.isnan(out[SP_THRUST])  # PX4 does not wait for a thrust
        flies = not commander.landed or (ready and climbs(out, now.truth))
        now.setpoint, now.motors_on = out, flies and not commander.terminated
        self.flush_texts()

    def flush_texts(self) -> None:
        """Broadcast the commander's queued status texts, up to a limit per tick."""
        texts, self.commander.texts = self.commander.texts, []
        for severity, text in texts[: self._texts_left]:
            self._texts_left -= 1
            self._text_id = self._text_id % 0xFFFF + 1
            # The TAB marks a text that clients of the events interface also receive there.
            data = text.encode("ascii", "replace") + b"\t"
            for message in text_messages(severity, data, self._text_id):
                self.broadcast(message)


# Command authority --------------------------------------------------------------------------------

_MOST_WARNED = 64  # maximum number of senders remembered as warned

# Commands that anybody may send, because they change nothing but the sender's own streams.
_HARMLESS = (
    dialect.MAV_CMD_REQUEST_MESSAGE,
    dialect.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES,
    dialect.MAV_CMD_SET_MESSAGE_INTERVAL,
    dialect.MAV_CMD_GET_MESSAGE_INTERVAL,
    dialect.MAV_CMD_GET_HOME_POSITION,
    dialect.MAV_CMD_RUN_PREARM_CHECKS,
)

_COMMANDS = ("COMMAND_LONG", "COMMAND_INT")
_COMMANDING = (
    *_COMMANDS, "SET_MODE", "MANUAL_CONTROL", "PARAM_SET", "SET_POSITION_TARGET_LOCAL_NED",
    "SET_POSITION_TARGET_GLOBAL_INT", "SET_ATTITUDE_TARGET",
)  # fmt: skip

_Sender = tuple[Link, int, int]  # link, system, component


class _Authority:
    """Decides whose commands and whose setpoints the vehicle obeys.

    It obeys the commands of trusted systems, or of all systems if `trusted` is empty. It follows
    the setpoints of one sender at a time: the first keeps control until it has been silent for
    longer than OFFBOARD tolerates. Warnings go to `queue_text`.
    """

    def __init__(self, trusted: Sequence[int], queue_text: Callable[[Severity, str], None]) -> None:
        self._trusted = frozenset(trusted)
        self._queue_text = queue_text
        self._holder: _Sender | None = None
        self._held_us = 0
        self._warned: set[_Sender] = set()

    def may_command(self, message: Any, link: Link) -> bool:
        """Return False if a message commands the vehicle and its sender is not trusted."""
        system = message.get_srcSystem()
        if not self._trusted or system in self._trusted:
            return True
        kind = message.get_type()
        if kind not in _COMMANDING or (kind in _COMMANDS and message.command in _HARMLESS):
            return True
        names = ", ".join(map(str, sorted(self._trusted)))
        self._warn_once((link, system, 0), f"Commands of system {system} refused, trusted: {names}")
        return False

    def follows(self, message: Any, link: Link, stamp_us: int, silence_us: float) -> bool:
        """Return True if the vehicle should follow a valid setpoint; if so, remember its sender.

        Once that sender has been silent for longer than `silence_us`, another may take over.
        """
        sender = (link, message.get_srcSystem(), message.get_srcComponent())
        holder = self._holder
        if holder is not None and holder != sender:
            if stamp_us - self._held_us <= silence_us:
                text = f"Setpoints of {_name(sender)} ignored: {_name(holder)} commands"
                self._warn_once(sender, text)
                return False
            text = f"{_name(sender)} commands instead of {_name(holder)}"
            self._queue_text(Severity.WARNING, text)
            self._warned.clear()
        self._holder, self._held_us = sender, stamp_us
        return True

    def _warn_once(self, sender: _Sender, text: str) -> None:
        if sender not in self._warned:
            if len(self._warned) >= _MOST_WARNED:
                self._warned.clear()
            self._warned.add(sender)
            self._queue_text(Severity.WARNING, text)


def _name(sender: _Sender) -> str:
    return f"{sender[1]}/{sender[2]}"
