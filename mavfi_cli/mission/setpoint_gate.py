"""The gate between any companion and its autopilot: withholds anomalous setpoints.

The gate judges every setpoint together with the vehicle's state. A setpoint that raises an alarm
does not reach the autopilot, unless the gate only watches. A setpoint sent in its place is the
reference for the next one. Every other frame passes unchanged.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mavfi_cli.core.errors import described
from mavfi_cli.core.types import Command, StackMark, Stage, Trajectory
from mavfi_cli.detect.gate import Alarm, Gate
from mavfi_cli.link.codec import Codec, Message, Signing, dialect, frame_of, renewed, text_messages
from mavfi_cli.link.peers import Peer
from mavfi_cli.link.router import Side
from mavfi_cli.mission.setpoints import SETPOINTS, SetpointView
from mavfi_cli.spec.companion import GateConfig
from mavfi_cli.spec.detector import DetectorConfig

_COMPONENT = dialect.MAV_COMP_ID_ONBOARD_COMPUTER4  # sender of the gate's own messages
_SILENT_S = 3.0  # wall-clock time without a heartbeat after which its sender is gone
_TEXT_EVERY_S, _STALE_EVERY_S = 1.0, 60.0
_BLIND_S = 3.0  # time of setpoints without the vehicle's state until the gate says so
_BLIND = (
    "the autopilot has not sent HEARTBEAT, LOCAL_POSITION_NED and ATTITUDE: setpoints are judged "
    "without the vehicle's state"
)
_MOST_ALARMS, _MOST_STREAMS = 100, 16
_BRAKE = 0b1101_1100_0111  # type_mask of a velocity-only setpoint


@dataclass(slots=True)
class _Counts:
    """Numbers of anomalous or stale setpoints, by what the gate sent in their place."""

    hold: int = 0  # the last accepted setpoint
    brake: int = 0  # a standstill
    autopilot: int = 0  # nothing: the autopilot was switched to hold, or notices the silence
    stale: int = 0  # nothing, unless the gate only watches: the companion is gone
    none: int = 0  # the setpoint itself: the gate only watches
    alarms: list[dict[str, Any]] = field(default_factory=list)


@dataclass(slots=True)
class _Stream:
    """The newest setpoint of one sender and kind."""

    content: tuple[str, ...]
    since_s: float  # since when it is the same
    told_s: float = -math.inf  # when it was last said that it is stale


class SetpointGate:
    """The gate between one companion and its autopilot.

    Args:
        mark: Companion for which the detector's model must have been made; None allows any.
        note: Called with kind and text of each event: `program` for a second sender, else `alarm`.
        signing: Key of the link, for signing replacement setpoints and the gate's own messages.
        gone: Returns why the companion's process is gone; empty while it runs.
        speed: Seconds of `now_s` per second of the wall clock, by which companions send heartbeats.
            If it is infinite, a missing heartbeat does not show that a companion is gone.

    Attributes:
        outbox: Frames of the gate itself, for the autopilot and the companion. The owner sends and
            removes them.

    Raises:
        ModelError: The model cannot be used.
        UnknownName: No detector has this name.
    """

    def __init__(
        self,
        detector: DetectorConfig,
        settings: GateConfig,
        mark: StackMark | None,
        *,
        note: Callable[[str, str], None],
        signing: Signing | None = None,
        gone: Callable[[], str] = str,
        speed: float = 1.0,
    ) -> None:
        self._config, self._settings = detector, settings
        stages = frozenset(Stage(name) for name in detector.protect)
        self._gate = Gate(detector.build_for_companion(mark), stages)
        self._view, self._note, self._signing, self._gone = SetpointView(), note, signing, gone
        self._codec = Codec(1, _COMPONENT, signing=signing)
        self._accepted: Message | None = None
        self._yaw_rad = 0.0  # yaw of the last accepted setpoint, kept at a standstill
        self._in_a_row = self._checks = 0
        self._counts = _Counts()
        self._noted_s = self._handed_s = -math.inf
        self._silent_s = _SILENT_S * speed
        self._heartbeats: dict[tuple[int, int], float] = {}  # newest, by system and component
        # By peer, system, component and message id.
        self._steady: dict[tuple[Peer | None, int, int, int], _Stream] = {}
        self._commanders = SetpointView.Commanders()
        self._failed = False
        self._withheld = False  # what was last said of a setpoint
        self._blind_s = math.inf  # stamp of the first setpoint without the vehicle's state
        self._told_blind = False
        self.outbox: list[bytes] = []

    @staticmethod
    def warm_up(detector: DetectorConfig, mark: StackMark | None) -> None:
        """Load and compile all code that a gate needs, in advance.

        Raises the same errors as the constructor.
        """
        gate = Gate(detector.build_for_companion(mark))
        still = Command(stamp_s=0.0, velocity_enu_mps=np.zeros(3), yaw_rad=0.0)
        plan = Trajectory(
            stamp_s=0.0, waypoints=np.zeros((1, 10)), durations_s=np.ones(1), trajectory_seq=0,
            future_collision_seq=0,
        )  # fmt: skip
        for trajectory in (None, plan):
            gate.judge_tick(trajectory, 0, still)

    def pass_between(
        self, message: Message, side: Side, now_s: float, sender: Peer | None = None
    ) -> list[Message]:
        """Return the messages to pass on in place of a message: usually the message itself.

        Args:
            sender: Peer that has sent the message; None if it is not known.
        """
        number = message.get_msgId()
        if side is Side.COMPANION and number not in SETPOINTS:
            if number == dialect.MAVLINK_MSG_ID_HEARTBEAT:
                self._heartbeats[message.get_srcSystem(), message.get_srcComponent()] = now_s
            return [message]
        try:
            if side is Side.AUTOPILOT:
                self._view.hear(message)
                return [message]
            return self._judge(message, now_s, sender)
        except Exception as error:  # the gate's boundary: it fails as configured
            if not self._failed:
                self._say(f"gate fails {self._settings.on_error}: {described(error)}", math.inf)
            self._failed = True
            passes = side is Side.AUTOPILOT or self._settings.on_error == "open"
            return [message] if passes else []

    def _judge(self, message: Message, now_s: float, sender: Peer | None) -> list[Message]:
        if text := self._commanders.another(message, sender):
            self._say(text, math.inf, "program")
        if self._is_stale(message, now_s, sender):
            self._counts.stale += 1
            return [message] if self._settings.watch_only else []
        self._checks += 1
        sample = self._view.sample(message)
        if sample[0] is None and not self._told_blind:
            self._blind_s = min(self._blind_s, now_s)
            if now_s - self._blind_s > _BLIND_S:
                self._told_blind = self._say(_BLIND, math.inf)
        alarm = self._gate.judge_tick(*sample)
        if alarm is None:
            if self._withheld and self._say("setpoints pass again", now_s):
                self._withheld = False
            self._in_a_row, self._accepted, self._yaw_rad = 0, message, sample[2].yaw_rad
            return [message]
        self._in_a_row += 1
        if self._settings.watch_only:
            self._gate.accept_tick()
            self._counts.none += 1
            self._record(alarm, now_s, "none")
            return [message]
        action = self._settings.action
        late = self._in_a_row > self._settings.patience
        if action == "hold" and (late or self._accepted is None):
            action = "brake"
        self._record(alarm, now_s, action)
        if action == "hold":
            self._counts.hold += 1
            return self._again(message)
        if action == "autopilot":
            self._counts.autopilot += 1
            self._hand_over(now_s)
            return []
        self._counts.brake += 1
        return self._standstill(message)

    def _is_stale(self, message: Message, now_s: float, sender: Peer | None) -> bool:
        """Return True if a setpoint is stale. Say so once, and then every minute.

        Setpoints are stale if their sender no longer changes them, and the companion is gone or
        this sender sends no more heartbeats.
        """
        ids = message.get_srcSystem(), message.get_srcComponent()
        content = tuple(  # as text, because NaN differs from itself
            repr(getattr(message, name)) for name in message.fieldnames if name != "time_boot_ms"
        )
        key = (sender, *ids, message.get_msgId())
        stream = self._steady.pop(key, None)
        if stream is None or stream.content != content:
            stream = _Stream(content, now_s)
        self._steady[key] = stream
        if len(self._steady) > _MOST_STREAMS:
            del self._steady[next(iter(self._steady))]  # the one that has been silent longest
        if now_s - stream.since_s < self._settings.stale_s:
            return False
        why = self._gone()
        if not why and now_s - self._heartbeats.get(ids, now_s) > self._silent_s:
            why = "the companion's heartbeat is gone"
        doing = "pass" if self._settings.watch_only else "are withheld"
        is_due = now_s - stream.told_s >= _STALE_EVERY_S
        if why and is_due and self._say(f"{why}: its setpoints {doing}", now_s):
            stream.told_s = now_s
        return bool(why)

    def _again(self, message: Message) -> list[Message]:
        """Return the last accepted setpoint, with the header and time of the withheld `message`.

        Return an empty list if it is of another type or cannot be signed.
        """
        assert self._accepted is not None
        if self._accepted.get_msgId() != message.get_msgId():
            return []
        held = copy.copy(self._accepted)
        held.time_boot_ms, held._msgbuf = message.time_boot_ms, frame_of(message)
        valid = renewed(held, self._signing)
        return [] if valid is None else [valid]

    def _standstill(self, message: Message) -> list[Message]:
        """Return a setpoint with zero velocity, to be sent in place of `message`.

        It becomes the reference for the next setpoint. The list is empty if it cannot be signed.
        """
        still = Command(stamp_s=0.0, velocity_enu_mps=np.zeros(3), yaw_rad=self._yaw_rad)
        trajectory, index, _ = self._view.sample(message)
        if self._gate.judge_tick(trajectory, index, still) is not None:
            self._gate.accept_tick()
        setpoint = dialect.MAVLink_set_position_target_local_ned_message(
            message.time_boot_ms, message.target_system, message.target_component,
            dialect.MAV_FRAME_LOCAL_NED, _BRAKE, *[0.0] * 11,
        )  # fmt: skip
        setpoint._msgbuf = frame_of(message)  # its sequence number, sender and signing time
        valid = renewed(setpoint, self._signing)
        return [] if valid is None else Codec(0, 0).decode(frame_of(valid))

    def _hand_over(self, now_s: float) -> None:
        """Switch the autopilot to its own hold, at most once a second."""
        telemetry = self._view.telemetry
        if now_s - self._handed_s < _TEXT_EVERY_S or not telemetry.heard:
            return
        self._handed_s = now_s
        enabled = dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | (telemetry.armed << 7)
        mode = telemetry.autopilot.mode_parameters(telemetry.autopilot.hold_mode)
        command = dialect.MAVLink_command_long_message(
            telemetry.system, dialect.MAV_COMP_ID_AUTOPILOT1, dialect.MAV_CMD_DO_SET_MODE, 0,
            enabled, *mode, 0, 0, 0, 0,
        )  # fmt: skip
        self.outbox.append(self._codec.encode(command))

    def _record(self, alarm: Alarm, now_s: float, action: str) -> None:
        states = [_foreign_name(name) for name in alarm.states]
        if len(self._counts.alarms) < _MOST_ALARMS:
            self._counts.alarms.append(
                {
                    "stamp_s": round(now_s, 3),
                    "stage": alarm.stage.value,
                    "states": states,
                    "score": alarm.score if math.isfinite(alarm.score) else None,
                    "threshold": alarm.threshold,
                    "response": action,
                }
            )
        blamed = ", ".join(states[:2]) or "all inputs together"
        doing = "reported" if action == "none" else "withheld"
        self._say(f"setpoint {doing}: {blamed}: {alarm.detector} {alarm.score:.3g}", now_s)
        self._withheld = action != "none"

    def _say(self, text: str, now_s: float, kind: str = "alarm") -> bool:
        """Note an event, and send it as STATUSTEXT.

        Return False, and do nothing, within 1 s of the last event.
        """
        if now_s - self._noted_s < _TEXT_EVERY_S:
            return False
        self._noted_s = now_s if math.isfinite(now_s) else self._noted_s
        self._note(kind, text)
        self._codec.system = self._view.telemetry.system or 1
        data = f"mavfi gate: {text}".encode("ascii", "replace")
        for message in text_messages(dialect.MAV_SEVERITY_WARNING, data, self._checks % 65535 + 1):
            self.outbox.append(self._codec.encode(message))
        return True

    def summary(self) -> dict[str, Any]:
        """Return the record of the gate's checks, alarms and responses, as plain JSON values."""
        counts = self._counts
        names = ("hold", "brake", "autopilot", "stale", "none")
        responses = {name: getattr(counts, name) for name in names}
        return {
            "detector": self._config.name,
            "protect": list(self._config.protect),
            "threshold": self._gate.detector.threshold,
            "checks": {"setpoint": self._checks},
            "alarm_count": sum(responses.values()) - counts.stale,
            "responses": responses,
            "alarms": counts.alarms,
            "recoveries": {},
        }


def _foreign_name(name: str) -> str:
    """Rename a detector's input for a user's companion, such as `waypoint_x` to `state_x`.

    There, the inputs have another meaning, which the module `setpoints` describes.
    """
    return name.replace("waypoint_", "state_").replace("command_", "setpoint_")
