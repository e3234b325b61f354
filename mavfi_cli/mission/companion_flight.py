"""One flight of a user's companion: mavfi starts and connects it, and judges the flight.

The vehicle's clock is simulated time. Programs run on the wall clock, so a flight is not
repeatable.

A flight in lockstep is repeatable if its companion is. The vehicle sends all messages of a tick,
ending with LOCAL_POSITION_NED, and waits. The companion sends its messages, ending with a
SET_POSITION_TARGET_LOCAL_NED with the same time_boot_ms. Then the next tick begins. Programs, fault
and outcome are checked only at a tick or while the companion is gone, so the wall clock determines
only when to give up.
"""

from __future__ import annotations

import contextlib
import math
import socket
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from mavfi_cli.core.errors import ConfigError, LinkLost
from mavfi_cli.core.flight_record import ProgramEnds
from mavfi_cli.core.frames import norm
from mavfi_cli.core.types import Briefing, Command, FloatArray, Outcome, VehicleState
from mavfi_cli.core.wall import WallClock
from mavfi_cli.fi.fault import Effect
from mavfi_cli.fi.injector import Moment
from mavfi_cli.link.codec import Codec, Message, dialect, frame_of
from mavfi_cli.link.endpoint import LISTENING, parse_endpoint
from mavfi_cli.link.router import Router, Side
from mavfi_cli.link.telemetry import AUTOPILOT, Telemetry
from mavfi_cli.link.tlog import EPOCH_UNIX_S, TlogWriter
from mavfi_cli.link.transport import Transport, open_transport, signing_from_file
from mavfi_cli.mission.companion_faults import CompanionFault
from mavfi_cli.mission.crew import Crew
from mavfi_cli.mission.programs import Programs
from mavfi_cli.mission.progress import FlightLogger, FlightProgress, Watcher
from mavfi_cli.mission.run_folder import RunFolder, Trace, load_run
from mavfi_cli.mission.setpoint_gate import SetpointGate
from mavfi_cli.mission.setpoints import SETPOINTS, SetpointView, command_of
from mavfi_cli.mission.success import SuccessVerdict
from mavfi_cli.spec.companion import CompanionConfig
from mavfi_cli.spec.mission import OWN_AUTOPILOT, MissionConfig

_TURN_S = 0.02
_SERVE_S = 0.02  # longest time to serve the links in a turn
_HEARTBEATS_S = 2.0  # time in which a heartbeat reports that the vehicle is armed
_BOOT_S = 60.0  # simulated time after which programs start even if the vehicle cannot arm yet
_SILENCE_S = 60.0  # wall-clock time without a message after which the vehicle counts as lost
_NO_SYSTEM = 255  # target of a setpoint that ends a tick and commands nothing
_NO_TARGET = (0x0FFF, *[0.0] * 11)  # type mask that ignores all fields, and the fields
_POSITION = dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED
_SETPOINT = dialect.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED


class CompanionFlight:
    """One flight of a user's companion, from the start of its first program to the outcome.

    Args:
        link: Open link to the vehicle. The caller closes it.
        interrupts: Signals received so far that request the end of the flight.

    Attributes:
        programs: At the end, how often each program has started and how its processes ended.
    """

    def __init__(
        self,
        config: MissionConfig,
        companion: CompanionConfig,
        link: Transport,
        watcher: Watcher,
        interrupts: Sequence[int],
        injection: CompanionFault,
    ) -> None:
        self._config, self._companion = config, companion
        self._interrupts, self._watcher = interrupts, watcher
        self.injection = injection
        self.telemetry = Telemetry()
        self.logger, self.trace, self.wall = FlightLogger(watcher), Trace(), WallClock()
        self._tlog = TlogWriter(EPOCH_UNIX_S)
        self._link = link
        self._router = Router(link, self._open_companion(companion.url), passes=self._pass)
        self.stamp_s = self.begun_s = self.end_s = 0.0
        self._begun = False
        self.takeover_s = math.inf  # stamp of the first arming
        self.outcome: Outcome | None = None
        self.reason = ""
        self.programs: dict[str, ProgramEnds] = {}
        self._heard_s = time.monotonic()
        self._spoken = False  # a program has sent a message
        self._command: Command | None = None
        self._gate = self._planned_gate()
        self._commanders = SetpointView.Commanders()
        self._ticks = 0  # since the first arming
        self._mode, self._failsafe = "", False
        self._failsafe_in_air = False  # in command when the vehicle was last in the air
        self._over_s = math.inf  # stamp at which every program had ended
        self._next_progress_s = 0.0
        self._crew = Crew(companion, self.logger.note)
        self._verdict = SuccessVerdict(companion.success, self._crew)
        self._golden_s = _flight_s_of(companion.success.golden)
        self._time_limit_s = min(config.time_limit_s, companion.time_limit_s or math.inf)
        self._goal_enu_m: FloatArray | None = None

    def _open_companion(self, url: str) -> str | Transport:
        """Return the router's link to the companion: its URL, or an open transport."""
        return url

    def _planned_gate(self) -> SetpointGate | None:
        detector = self._config.detector
        if detector is None:
            return None

        def note(kind: str, text: str) -> None:
            self.logger.note(self.stamp_s, kind, text, self.telemetry.state)

        return SetpointGate(
            detector, self._companion.gate, self._companion.mark, note=note,
            signing=signing_from_file(self._companion.key_file), gone=lambda: self._crew.ended(),
            speed=self._speed,
        )  # fmt: skip

    @property
    def _speed(self) -> float:
        """Simulated seconds per second of the wall clock; infinite if they are unrelated."""
        return self._config.speed

    @property
    def detection(self) -> dict[str, Any] | None:
        """The record of the gate's checks and alarms, or None if the flight has no gate."""
        return None if self._gate is None else self._gate.summary()

    def close(self) -> None:
        """Close the link to the companion."""
        self._router.close()

    def fly(self, folder: RunFolder, briefing: Briefing, depth: Path | None) -> None:
        """Fly until the mission has an outcome.

        Args:
            depth: Path of the socket that sends the vehicle's depth frames, or None without one.

        Raises:
            MavfiError: A program cannot be started, or the record cannot be written.
        """
        self._goal_enu_m = self._verdict.goal_enu_m = briefing.goal_enu_m
        self._tlog.open(folder.tlog)
        programs = Programs(folder.programs)
        with (
            contextlib.closing(self._tlog),
            contextlib.closing(programs),
            contextlib.closing(self._crew),
            contextlib.closing(self.injection),
        ):
            folder.write_briefing(briefing)
            self._crew.prepare(programs, self._placeholders(folder, briefing, depth))
            self.injection.running = self._crew.running
            self.injection.aim_at(self._shortest_flight_s(briefing))
            self.injection.begin(folder.fault)
            try:
                while self.outcome is None:
                    self._turn()
            except LinkLost as error:
                self._end(Outcome.LINK_LOST, str(error))
            self.programs = self._crew.summary()  # before they are ended

    def _turn(self) -> None:
        """Forward frames for a moment, then check programs, fault and outcome."""
        self._router.turn(_TURN_S, time.monotonic() + _SERVE_S)
        if self._crew.running or self.telemetry.ready or self.stamp_s > _BOOT_S:
            self._crew.manage(self.stamp_s, self.telemetry.state)
        self._strike()
        self._judge()

    def explain(self, why: str) -> None:
        """If the link was lost, append the failure of the vehicle's process to the reason."""
        if self.outcome is Outcome.LINK_LOST:
            self.reason = f"{self.reason}: {why}"

    def _shortest_flight_s(self, briefing: Briefing) -> float:
        """Return the length in seconds of the interval from which a random fault time is drawn."""
        way_m = norm(briefing.goal_enu_m - briefing.start_enu_m)
        flight_s = self._companion.flight_s or self._golden_s or way_m / self._config.v_max_mps
        return min(flight_s, self._time_limit_s)

    def _placeholders(
        self, folder: RunFolder, briefing: Briefing, depth: Path | None
    ) -> dict[str, str]:
        """Return the values of the placeholders in the programs' commands, keyed by placeholder."""
        end = parse_endpoint(self._companion.url)
        port = self._router.port if end.scheme in LISTENING else end.port
        called = end.scheme in LISTENING
        udp = end.scheme.startswith("udp")
        scheme = {True: "udpout", False: "udpin"}[called] if udp else "tcp"
        mavsdk = scheme if udp else "tcpout"
        return {
            "link": f"{scheme}:{end.host}:{port}",
            "mavsdk": f"{mavsdk}://{end.host}:{port}",
            "port": str(port),
            "free": str(_free_port()),
            "briefing": str(folder.briefing.resolve()),
            **({} if depth is None else {"camera": str(depth)}),
            "world": self._config.world,
            "start": ",".join(f"{value:g}" for value in briefing.start_enu_m),
            "goal": ",".join(f"{value:g}" for value in briefing.goal_enu_m),
            "seed": str(self._config.seed),
        }

    # Frames ---------------------------------------------------------------------------------------

    def _pass(self, message: Message, side: Side) -> Iterable[bytes]:
        if side is Side.AUTOPILOT:
            self._hear(message)
        else:
            self._spoken = True
        link = self.injection.link
        passed = [message] if link is None else link.pass_between(message, side, self._moment)
        return [frame for own in passed for frame in self._deliver(own, side)]

    def _gated(self, message: Message, side: Side) -> Iterable[Message]:
        """Return the messages that the gate passes on in place of a message.

        Also send the frames of the gate itself.
        """
        if self._gate is None:
            return (message,)
        passed = self._gate.pass_between(message, side, self.stamp_s, self._router.sender)
        if message not in passed and self.injection.link is not None:
            self.injection.link.follower.withheld(message)
        for frame in self._gate.outbox:
            self._tlog.write(self.stamp_s, frame)
            self._router.send(frame, Side.COMPANION)
        self._gate.outbox.clear()
        return passed

    def _deliver(self, message: Message, side: Side) -> Iterable[bytes]:
        """Record the messages that reach the receiver in place of `message`.

        Return their frames.
        """
        passed = self._gated(message, side)
        for own in passed:
            if side is Side.COMPANION:
                self._watch(own)
            if self.injection.link is not None:
                self.injection.link.deliver(own, side, self.stamp_s)
        frames = [frame_of(own) for own in passed]
        self._tlog.write(self.stamp_s, *frames)
        return frames

    @property
    def _moment(self) -> Moment:
        flight_s = self.stamp_s - self.takeover_s
        return Moment(stamp_s=self.stamp_s, flight_s=flight_s, tick=self._ticks, phase=self._mode)

    def _strike(self) -> None:
        """Strike a process if the fault is due, pass late messages on, and log the fault."""
        self.injection.tick(self._moment)
        if self.injection.link is not None:
            for message, side in self.injection.link.release(self.stamp_s):
                for frame in self._deliver(message, side):
                    self._router.send_late(frame, side, message)
        for text in self.injection.news():
            self.logger.note(self.stamp_s, "fault", text, self.telemetry.state)

    def _hear(self, message: Message) -> None:
        """Handle a message from the vehicle's side."""
        self._heard_s = time.monotonic()
        telemetry = self.telemetry
        if not isinstance(message, dialect.MAVLink_unknown):
            telemetry.handle(message)
        if not telemetry.is_from(message, AUTOPILOT):
            return
        stamp_ms = getattr(message, "time_boot_ms", None)
        if stamp_ms is not None:
            if not self._begun:
                self._begun, self.begun_s = True, stamp_ms / 1e3
            self.stamp_s = telemetry.now_s = max(self.stamp_s, stamp_ms / 1e3)
        if isinstance(message, dialect.MAVLink_heartbeat_message):
            self._note_mode(message)
        elif message.get_msgId() == _POSITION and telemetry.state is not None:
            self._tick(telemetry.state)

    def _note_mode(self, heartbeat: Message) -> None:
        telemetry = self.telemetry
        if telemetry.mode != self._mode:
            self._mode = telemetry.mode
            self.logger.note(self.stamp_s, "phase", telemetry.mode, telemetry.state)
        if telemetry.armed and self.takeover_s == math.inf:
            self.takeover_s = self.stamp_s
        failsafe = heartbeat.system_status == dialect.MAV_STATE_CRITICAL
        if failsafe and not self._failsafe:
            self.logger.note(
                self.stamp_s, "autopilot", "a failsafe has taken over", telemetry.state
            )
        self._failsafe = failsafe
        if telemetry.in_air:
            self._failsafe_in_air = failsafe

    def _tick(self, state: VehicleState) -> None:
        """Record a new state, and report progress once per simulated second."""
        self._ticks += self.takeover_s < math.inf
        self.trace.add(state.stamp_s, self._mode, state, None, None, self._command)
        self._verdict.see(state)
        if state.stamp_s < self._next_progress_s:
            return
        self._next_progress_s = state.stamp_s + 1.0
        assert self._goal_enu_m is not None
        self._watcher.on_progress(
            FlightProgress(
                stamp_s=state.stamp_s, phase=self._mode, speed_mps=norm(state.velocity_enu_mps),
                goal_distance_m=norm(state.position_enu_m - self._goal_enu_m), replans=0,
            )
        )  # fmt: skip

    def _watch(self, message: Message) -> None:
        """Handle a message from the companion's side."""
        if isinstance(message, dialect.MAVLink_heartbeat_message):
            self._crew.hear(message.get_srcSystem(), message.get_srcComponent())
        if message.get_msgId() not in SETPOINTS:
            return
        another, sender = self._commanders.another, self._router.sender
        # The gate notes it, if there is one.
        if self._gate is None and (text := another(message, sender)):
            self.logger.note(self.stamp_s, "program", text, self.telemetry.state)
        if message.get_msgId() == _SETPOINT and self.telemetry.state is not None:
            self._command = command_of(message, self.telemetry)

    # The end --------------------------------------------------------------------------------------

    def _judge(self) -> None:
        telemetry = self.telemetry
        telemetry.expire()
        self.logger.log_texts(self.stamp_s, telemetry)
        armed_once = math.isfinite(self.takeover_s)
        flown_s = self.stamp_s - (self.takeover_s if armed_once else self._crew.begun_s)
        on_ground = telemetry.landed_state == dialect.MAV_LANDED_STATE_ON_GROUND
        flew = self._verdict.flew = self._verdict.flew or telemetry.in_air
        down = flew and on_ground and not telemetry.armed
        self._verdict.landed = down and not self._failsafe_in_air
        failure = self._crew.failure()
        if telemetry.collision_text is not None:
            self._end(Outcome.COLLISION, telemetry.collision_text.removeprefix("Collision: "))
        elif self._interrupts:
            self._end(Outcome.INTERRUPTED)
        elif self._verdict.is_over():
            if deviation := self._verdict.deviation():
                self._end(Outcome.TIMEOUT, deviation)
            else:
                self._end(Outcome.SUCCESS, self._verdict.describe())
        elif self._crew.unready:
            self._end(Outcome.CRASH, self._crew.unready)
        elif down and self._failsafe_in_air and self._companion.success.landed:
            self._end(Outcome.FAILSAFE, "a failsafe of the autopilot landed the vehicle")
        elif self._is_alone() and (down or self._failsafe or not telemetry.armed):
            if failure:
                self._end(Outcome.CRASH, failure)
            elif self._failsafe:
                self._end(Outcome.FAILSAFE, "the companion ended and the autopilot took over")
            else:
                self._end(Outcome.TIMEOUT, "the companion ended its flight without success")
        elif flown_s >= self._time_limit_s:
            never = "armed the vehicle" if self._spoken else "sent a MAVLink message"
            late = "" if armed_once else f"the companion never {never}"
            self._end(Outcome.TIMEOUT, failure or late)
        elif time.monotonic() - self._heard_s > _SILENCE_S:
            self._end(Outcome.LINK_LOST, f"the vehicle sent nothing for {_SILENCE_S:g} s")

    def _is_alone(self) -> bool:
        """Return True if all programs have ended, and a heartbeat has told their last effect."""
        if not self._crew.over:
            return False
        self._over_s = min(self._over_s, self.stamp_s)
        return self.stamp_s - self._over_s > _HEARTBEATS_S

    def _end(self, outcome: Outcome, reason: str = "") -> None:
        self.outcome, self.reason, self.end_s = outcome, reason, self.stamp_s
        text = outcome.value.replace("_", " ") + (f": {reason}" if reason else "")
        self.logger.note(self.stamp_s, "outcome", text, self.telemetry.state)


def _flight_s_of(golden: str | None) -> float | None:
    """Return the flight time of a golden flight, in seconds. Return None if it has none."""
    return None if golden is None else load_run(golden).record.quality_of_flight.flight_time_s


def _free_port() -> int:
    """Return a TCP port that is currently free on this machine."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class LockstepFlight(CompanionFlight):
    """A flight in which simulated time stands still while the companion computes.

    Raises:
        ConfigError: The mission's autopilot, speed or fault needs the wall clock.
    """

    _end_of_link: Transport
    _tick_ms = 0  # stamp of the vehicle's newest tick
    _awaited_ms: int | None = None  # stamp of the tick that the companion must answer, if any
    _since_s = 0.0  # when the present wait began

    def _open_companion(self, url: str) -> Transport:
        self._require_lockstep()
        self._end_of_link = open_transport(url)
        return self._end_of_link

    @property
    def _speed(self) -> float:
        return math.inf

    def _require_lockstep(self) -> None:
        config, fault = self._config, self._config.fault
        stops = fault is not None and bool(fault.killed_node)
        for key, by_wall in (
            ("autopilot", config.autopilot != OWN_AUTOPILOT),
            ("speed", config.speed != 1.0),
            ("effect", stops and fault is not None and fault.effect != Effect.FLIP.value),
        ):
            if by_wall:
                raise ConfigError("works only with a companion that sets time = 'wall'", key=key)

    def _turn(self) -> None:
        """Start the program and await its connection. After that, await the next answer or tick."""
        if self._crew.ready:
            self._router.turn(_TURN_S, time.monotonic() + _SERVE_S)
            self._look_after()
            return
        self._crew.connected = self._end_of_link.await_peer(_TURN_S)
        self._crew.manage(self.stamp_s, self.telemetry.state)
        self._heard_s = self._since_s = time.monotonic()
        self._judge()

    def _look_after(self) -> None:
        """End the flight if the vehicle or the companion has been silent for too long.

        Once the companion has ended, answer the vehicle's ticks in its place.
        """
        waited_s, limit_s = time.monotonic() - self._since_s, self._companion.answer_limit_s
        if self.outcome is not None:
            pass
        elif self._interrupts:
            self._end(Outcome.INTERRUPTED)
        elif self._awaited_ms is None:
            if waited_s > _SILENCE_S:
                self._end(Outcome.LINK_LOST, f"the vehicle sent nothing for {_SILENCE_S:g} s")
        elif waited_s > limit_s:
            name, *_ = self._crew.running
            text = f"{name} did not answer the tick at {self._tick_ms} ms within {limit_s:g} s"
            self._end(Outcome.HANG, text)
        elif not any(peer.side is Side.COMPANION for peer in self._router.peers):
            self._crew.manage(self.stamp_s, self.telemetry.state)
            if self._crew.over:
                self._heard_s = time.monotonic()
                self._judge()
                self._go_on()

    # Frames ---------------------------------------------------------------------------------------

    def _pass(self, message: Message, side: Side) -> Iterable[bytes]:
        ends_tick = side is Side.AUTOPILOT and self._is_tick(message)
        answers = self._answers(message, side)
        if ends_tick:
            self._tick_ms, self._awaited_ms = message.time_boot_ms, None
        frames = [*super()._pass(message, side)]
        if self.outcome is not None:
            return ()
        if ends_tick:
            self._since_s = time.monotonic()
            if self._awaited_ms is None:  # a fault has kept the tick from the companion
                self._go_on()
        elif answers:
            reaches = message.time_boot_ms == self._tick_ms and frame_of(message) in frames
            self._awaited_ms, self._since_s = None, time.monotonic()
            if not reaches:  # a fault or the gate has changed it
                frames.append(self._release())
        # In one piece, because the vehicle goes on after the read that contains the answer.
        return [b"".join(frames)] if frames else ()

    def _is_tick(self, message: Message) -> bool:
        return message.get_msgId() == _POSITION and self.telemetry.is_from(message, AUTOPILOT)

    def _answers(self, message: Message, side: Side) -> bool:
        return (
            side is Side.COMPANION
            and message.get_msgId() == _SETPOINT
            and message.time_boot_ms == self._awaited_ms
        )

    def _go_on(self) -> None:
        """Answer the vehicle's tick in place of the companion, unless the flight has ended."""
        if self.outcome is None:
            self._awaited_ms, self._since_s = None, time.monotonic()
            self._link.send(self._release())

    def _release(self) -> bytes:
        """Return a setpoint that ends the tick and that the autopilot otherwise ignores."""
        return Codec(_NO_SYSTEM, 0).encode(
            dialect.MAVLink_set_position_target_local_ned_message(
                self._tick_ms, _NO_SYSTEM, 0, dialect.MAV_FRAME_LOCAL_NED, *_NO_TARGET
            )
        )

    def _hear(self, message: Message) -> None:
        """Handle a message from the vehicle.

        After the last message of a tick, strike if the fault is due, and judge the flight.
        """
        super()._hear(message)
        if self._is_tick(message):
            self._strike()
            self._awaited_ms = None  # a late message does not start a tick
            self._judge()

    def _deliver(self, message: Message, side: Side) -> Iterable[bytes]:
        if side is Side.AUTOPILOT and self._is_tick(message):
            self._awaited_ms = message.time_boot_ms
        return super()._deliver(message, side)
