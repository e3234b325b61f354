"""One flight of a user's own companion, which mavfi starts, connects and judges.

The vehicle's clock is simulated time. Programs run by the wall clock, so a flight does not repeat.
"""

from __future__ import annotations

import contextlib
import math
import signal
import socket
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mavfi_cli.companion.injection import NoInjection
from mavfi_cli.core.errors import ConfigError, LinkLost, MavfiError
from mavfi_cli.core.files import read_parquet
from mavfi_cli.core.flight_record import ProgramEnds
from mavfi_cli.core.frames import norm
from mavfi_cli.core.types import Briefing, Command, FloatArray, Outcome, VehicleState
from mavfi_cli.core.wall import WallClock
from mavfi_cli.fi.injector import Moment
from mavfi_cli.link.codec import Message, dialect, frame_of
from mavfi_cli.link.endpoint import LISTENING, parse_endpoint
from mavfi_cli.link.router import Router, Side
from mavfi_cli.link.telemetry import AUTOPILOT, Telemetry
from mavfi_cli.link.tlog import EPOCH_UNIX_S, TlogWriter
from mavfi_cli.link.transport import Transport, signing_from_file
from mavfi_cli.mission.companion_faults import CompanionFault, Throttle
from mavfi_cli.mission.programs import Programs, RunningProgram
from mavfi_cli.mission.progress import FlightLogger, FlightProgress, Watcher
from mavfi_cli.mission.run_folder import RunFolder, Trace
from mavfi_cli.mission.setpoint_gate import SetpointGate
from mavfi_cli.mission.setpoints import command_of
from mavfi_cli.spec.companion import CompanionConfig, ProgramConfig, SuccessConfig
from mavfi_cli.spec.mission import MissionConfig

_TURN_S = 0.02
_SERVE_S = 0.02  # longest service of the links in a turn
_BOOT_S = 60.0  # simulated time after which programs start although the vehicle cannot arm yet
_SILENCE_S = 60.0  # wall-clock time without a message after which the vehicle counts as lost
_REST_MPS, _REST_S = 0.5, 1.0  # largest speed of a vehicle at rest, and how long it lasts
_PORT_LOOK_S = 0.1
_MOST_EVENTS = 1000
_POSITION = dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED
_SETPOINT = dialect.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED


class CompanionFlight:
    """One flight, from the start of the first program to its outcome.

    Args:
        link: Open link to the vehicle. Its opener closes it.
        interrupts: Signals that request the end.

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
        injection: NoInjection,
    ) -> None:
        self._config, self._companion = config, companion
        self._interrupts, self._watcher = interrupts, watcher
        self.injection = injection
        self.telemetry = Telemetry()
        self.logger, self.trace, self.wall = FlightLogger(watcher), Trace(), WallClock()
        self._tlog = TlogWriter(EPOCH_UNIX_S)
        self._router = Router(link, companion.link, passes=self._pass)
        self.stamp_s = self.begun_s = self.end_s = 0.0
        self.takeover_s = math.inf  # of the first arming
        self.outcome: Outcome | None = None
        self.reason = ""
        self.programs: dict[str, ProgramEnds] = {}
        self._heard_s = time.monotonic()
        self._command: Command | None = None
        self._gate = self._planned_gate()
        self._commanders: set[tuple[int, int]] = set()
        self._ticks = 0  # since the first arming
        self._faults = injection if isinstance(injection, CompanionFault) else None
        self._mode, self._failsafe = "", False
        self._next_progress_s = 0.0
        self._crew = _Crew(companion, self.logger)
        self._verdict = _Verdict(companion.success, self._crew)
        self._time_limit_s = min(config.time_limit_s, companion.time_limit_s or math.inf)
        self._goal_enu_m: FloatArray | None = None

    def _planned_gate(self) -> SetpointGate | None:
        detector = self._config.detector
        if detector is None:
            return None

        def note(text: str) -> None:
            self.logger.note(self.stamp_s, "alarm", text, self.telemetry.state)

        return SetpointGate(
            detector, self._companion.gate, self._companion.mark, note=note,
            signing=signing_from_file(self._companion.key_file), gone=lambda: self._crew.ended(),
        )  # fmt: skip

    @property
    def detection(self) -> dict[str, Any] | None:
        """Checks and alarms of the gate; None without one."""
        return None if self._gate is None else self._gate.summary()

    def close(self) -> None:
        """Close the companion's link."""
        self._router.close()

    def fly(self, folder: RunFolder, briefing: Briefing, depth: Path | None) -> None:
        """Fly until there is an outcome.

        Args:
            depth: Socket of the vehicle's depth frames; None if it has none.

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
            self._crew.prepare(programs, self._placeholders(briefing, depth))
            if self._faults is not None:
                self._faults.running = self._crew.running
                self._faults.aim_at(self._shortest_flight_s(briefing))
                self._faults.begin(folder.fault)
            try:
                while self.outcome is None:
                    self._router.turn(_TURN_S, time.monotonic() + _SERVE_S)
                    if self.telemetry.ready or self.stamp_s > _BOOT_S:
                        self._crew.manage(self.stamp_s, self.telemetry.state)
                    self._strike()
                    self._judge()
            except LinkLost as error:
                self._end(Outcome.LINK_LOST, str(error))
            self.programs = self._crew.summary()  # before they are ended

    def explain(self, why: str) -> None:
        """Add the failure of the vehicle's process to the reason for a lost link."""
        if self.outcome is Outcome.LINK_LOST:
            self.reason = f"{self.reason}: {why}"

    def _shortest_flight_s(self, briefing: Briefing) -> float:
        """Return the time over which a random fault is drawn, s."""
        way_m = norm(briefing.goal_enu_m - briefing.start_enu_m)
        return self._companion.flight_s or way_m / self._config.v_max_mps

    def _placeholders(self, briefing: Briefing, depth: Path | None) -> dict[str, str]:
        """Return the text of every placeholder of a command."""
        end = parse_endpoint(self._companion.link)
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
            **({} if depth is None else {"depth": str(depth)}),
            "world": self._config.world,
            "start": ",".join(f"{value:g}" for value in briefing.start_enu_m),
            "goal": ",".join(f"{value:g}" for value in briefing.goal_enu_m),
            "seed": str(self._config.seed),
        }

    # Frames ---------------------------------------------------------------------------------------

    def _pass(self, message: Message, side: Side) -> Iterable[bytes]:
        if side is Side.AUTOPILOT:
            self._hear(message)
        link = None if self._faults is None else self._faults.link
        passed = [message] if link is None else link.pass_between(message, side, self._moment)
        return [frame for own in passed for frame in self._deliver(own, side)]

    def _gated(self, message: Message, side: Side) -> Iterable[Message]:
        """Return what the gate passes on."""
        if self._gate is None:
            return (message,)
        passed = self._gate.pass_between(message, side, self.stamp_s)
        if message not in passed and self._faults is not None and self._faults.link is not None:
            self._faults.link.follower.withheld(message)
        for frame in self._gate.outbox:
            self._tlog.write(self.stamp_s, frame)
            self._router.send(frame, Side.COMPANION)
        self._gate.outbox.clear()
        return passed

    def _deliver(self, message: Message, side: Side) -> Iterable[bytes]:
        """Record what reaches the receiver in place of a message, and return its frames."""
        passed = self._gated(message, side)
        for own in passed:
            if side is Side.COMPANION:
                self._watch(own)
            if self._faults is not None and self._faults.link is not None:
                self._faults.link.deliver(own, side, self.stamp_s)
        frames = [frame_of(own) for own in passed]
        self._tlog.write(self.stamp_s, *frames)
        return frames

    @property
    def _moment(self) -> Moment:
        flight_s = self.stamp_s - self.takeover_s
        return Moment(stamp_s=self.stamp_s, flight_s=flight_s, tick=self._ticks, phase=self._mode)

    def _strike(self) -> None:
        """Strike a process if it is due, pass late messages on, and log the fault."""
        if self._faults is None:
            return
        self._faults.tick(self._moment)
        if self._faults.link is not None:
            for message, side in self._faults.link.release(self.stamp_s):
                for frame in self._deliver(message, side):
                    self._router.send(frame, side)
        for text in self._faults.news():
            self.logger.note(self.stamp_s, "fault", text, self.telemetry.state)

    def _hear(self, message: Message) -> None:
        """Handle a message of the vehicle's side."""
        self._heard_s = time.monotonic()
        telemetry = self.telemetry
        if not isinstance(message, dialect.MAVLink_unknown):
            telemetry.handle(message)
        if not telemetry.is_from(message, AUTOPILOT):
            return
        stamp_ms = getattr(message, "time_boot_ms", None)
        if stamp_ms is not None:
            self.begun_s = self.begun_s or stamp_ms / 1e3
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
        """Handle a message of the companion's side."""
        if isinstance(message, dialect.MAVLink_heartbeat_message):
            self._crew.heartbeat = True
        if message.get_msgId() != _SETPOINT:
            return
        sender = message.get_srcSystem(), message.get_srcComponent()
        if sender not in self._commanders and len(self._commanders) < _MOST_EVENTS:
            self._commanders.add(sender)
            if len(self._commanders) > 1:
                text = f"another commander, {sender[0]}/{sender[1]}, sends setpoints"
                self.logger.note(self.stamp_s, "program", text, self.telemetry.state)
        if self.telemetry.state is not None:
            self._command = command_of(message, self.telemetry.state)

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
        self._verdict.landed = down
        failure = self._crew.failure()
        if telemetry.collision_text is not None:
            self._end(Outcome.COLLISION, telemetry.collision_text.removeprefix("Collision: "))
        elif self._interrupts:
            self._end(Outcome.INTERRUPTED)
        elif self._verdict.succeeded():
            self._end(Outcome.SUCCESS, self._verdict.describe())
        elif self._crew.unready:
            self._end(Outcome.CRASH, self._crew.unready)
        elif self._crew.over and (
            down or self._failsafe or not telemetry.armed
        ):  # nothing further can happen
            if failure:
                self._end(Outcome.CRASH, failure)
            elif self._failsafe:
                self._end(Outcome.FAILSAFE, "the companion ended and the autopilot took over")
            else:
                self._end(Outcome.TIMEOUT, "the companion ended its flight without success")
        elif flown_s >= self._time_limit_s:
            late = "" if armed_once else "the companion never armed the vehicle"
            self._end(Outcome.TIMEOUT, failure or late)
        elif time.monotonic() - self._heard_s > _SILENCE_S:
            self._end(Outcome.LINK_LOST, f"the vehicle said nothing for {_SILENCE_S:g} s")

    def _end(self, outcome: Outcome, reason: str = "") -> None:
        self.outcome, self.reason, self.end_s = outcome, reason, self.stamp_s
        text = outcome.value.replace("_", " ") + (f": {reason}" if reason else "")
        self.logger.note(self.stamp_s, "outcome", text, self.telemetry.state)


class _Crew:
    """The programs of a companion during a flight: their order, readiness and ends.

    Attributes:
        begun_s: Stamp of the start of the first program; infinite before.
        running: Started programs by name.
        heartbeat: A MAVLink heartbeat has arrived from the companion.
        unready: Why the companion never became ready; empty while it may.
    """

    def __init__(self, companion: CompanionConfig, logger: FlightLogger) -> None:
        self._companion, self._logger = companion, logger
        self._waiting: list[tuple[str, ProgramConfig]] = list(companion.program.items())
        self.begun_s = math.inf
        self.running: dict[str, RunningProgram] = {}
        self.heartbeat = False
        self.unready = ""
        self._started_s = self._looked_s = 0.0  # of the newest program; wall clock
        self._known: dict[str, tuple[int, int]] = {}  # starts and ends that the log has
        self._throttles: list[Throttle] = []

    def prepare(self, programs: Programs, values: dict[str, str]) -> None:
        """Fill in the placeholders of all commands. Raises UnknownName for an unknown one."""
        self._programs = programs
        self._tasks = {name: _task(program, values) for name, program in self._waiting}

    def _start(self) -> None:
        name, _ = self._waiting[0]
        self.running[name] = self._programs.start(name, self._tasks[name])
        self._started_s = time.monotonic()
        if (share := self._companion.program[name].share) < 1.0:
            self._throttles.append(Throttle(self.running[name], share))

    def close(self) -> None:
        """Let slowed programs run, so that they can end."""
        for throttle in self._throttles:
            throttle.end()

    def manage(self, stamp_s: float, state: VehicleState | None) -> None:
        """Log starts and ends of programs, and start the next one if the newest is ready.

        Raises:
            MavfiError: A program cannot be started.
        """
        if not self.running:
            self.begun_s = stamp_s
            self._start()
        for name, program in self.running.items():
            if not program.poll():
                raise MavfiError(f"the program {name} cannot run: {program.failure()}")
            starts, ends = self._known.get(name, (0, 0))
            if program.starts > starts:
                again = " again" if program.starts > 1 else ""
                self._logger.note(stamp_s, "program", f"{name} starts{again}", state)
            for code in program.codes[ends:]:
                self._logger.note(stamp_s, "program", f"{name} {_how(code)}", state)
            self._known[name] = program.starts, len(program.codes)
        if self._waiting and not self.unready:
            self._await_ready()

    def _await_ready(self) -> None:
        name, config = self._waiting[0]
        program = self.running[name]
        if self._is_ready(config, program):
            del self._waiting[0]
            if self._waiting:
                self._start()
        elif program.codes and program.pid is None and self._is_over(name):
            self.unready = f"{name} {_how(program.codes[-1])} before it was ready"
        elif time.monotonic() - self._started_s > config.ready_limit_s:
            self.unready = f"{name} was not ready within {config.ready_limit_s:g} s"

    def _is_ready(self, config: ProgramConfig, program: RunningProgram) -> bool:
        return (
            program.starts > 0
            and (config.ready_line is None or program.ready)
            and (not config.ready_heartbeat or self.heartbeat)
            and (config.ready_port is None or self._is_open(config.ready_port))
        )

    def _is_open(self, port: int) -> bool:
        """Return True if a local TCP port accepts connections."""
        if time.monotonic() < self._looked_s + _PORT_LOOK_S:
            return False
        self._looked_s = time.monotonic()
        with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
            return probe.connect_ex(("127.0.0.1", port)) == 0

    def summary(self) -> dict[str, ProgramEnds]:
        """Return how often each program has started, and the exit codes of its processes."""
        return {
            name: ProgramEnds(starts=program.starts, codes=[*program.codes])
            for name, program in self.running.items()
        }

    @property
    def over(self) -> bool:
        """True once every program has ended for good."""
        return not self._waiting and all(map(self._is_over, self.running))

    def _is_over(self, name: str) -> bool:
        program, rule = self.running[name], self._companion.program[name].restart
        if program.pid is not None or not program.codes:
            return False
        return rule == "never" or (rule == "on-failure" and program.codes[-1] == 0)

    def failure(self) -> str:
        """Return how a program failed for good; empty if none has."""
        for name, program in self.running.items():
            if program.codes and program.codes[-1] and self._is_over(name):
                return f"{name} {_how(program.codes[-1])}"
        return ""

    def ended(self) -> str:
        """Return which program has ended, or does not run at present; empty if all run."""
        for name, program in self.running.items():
            if program.codes and program.pid is None:
                return f"the program {name} is gone"
        return ""

    def succeeded(self, name: str) -> bool:
        """Return True if a program has ended for good with code 0."""
        return name in self.running and self._is_over(name) and self.running[name].codes[-1] == 0


def _free_port() -> int:
    """Return a TCP port of this machine that is free now."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _how(code: int) -> str:
    """Describe the end of a process."""
    if code >= 0:
        return f"ended with code {code}"
    with contextlib.suppress(ValueError):
        return f"was killed by {signal.Signals(-code).name}"
    return f"was killed by signal {-code}"


def _task(program: ProgramConfig, values: dict[str, str]) -> dict[str, Any]:
    return {
        "argv": program.argv(values),
        "folder": program.folder,
        "environment": program.environment,
        "restart": program.restart,
        "restart_s": program.restart_s,
        "ready_line": program.ready_line,
    }


class _Verdict:
    """Decides whether a flight has succeeded.

    Attributes:
        goal_enu_m: Goal (3,).
        landed: The vehicle stands on the ground, disarmed, after a flight.
        flew: It has been in the air.

    Raises:
        RecordError: The golden flight of the corridor cannot be read.
        ConfigError: It has no trace.
    """

    def __init__(self, success: SuccessConfig, crew: _Crew) -> None:
        self._success, self._crew = success, crew
        self.goal_enu_m: FloatArray | None = None
        self.landed = self.flew = False
        self._rest_since_s = math.inf
        self._rests = False
        self.deviation_m = 0.0  # largest distance from the golden path
        self._path = None if success.golden is None else path_of(Path(success.golden))

    def see(self, state: VehicleState) -> None:
        """Handle a new state."""
        if self._path is not None:
            self.deviation_m = max(
                self.deviation_m, distance_from(state.position_enu_m, self._path)
            )
        near_m = self._success.goal_m
        assert self.goal_enu_m is not None
        if (
            near_m is None
            or norm(state.position_enu_m - self.goal_enu_m) > near_m
            or norm(state.velocity_enu_mps) > _REST_MPS
        ):
            self._rest_since_s, self._rests = math.inf, False
        else:
            self._rest_since_s = min(self._rest_since_s, state.stamp_s)
            self._rests = state.stamp_s - self._rest_since_s >= _REST_S

    def describe(self) -> str:
        """Describe the conditions of success."""
        success = self._success
        parts = (
            "" if success.goal_m is None else f"at rest within {success.goal_m:g} m of the goal",
            "landed" if success.landed else "",
            "" if success.exit is None else f"{success.exit} ended with code 0",
            "" if success.corridor_m is None else f"within {success.corridor_m:g} m of the path",
        )
        return ", ".join(filter(None, parts))

    def succeeded(self) -> bool:
        """Return True if all given conditions hold. A corridor alone does not end the flight."""
        success = self._success
        ends = (
            *([self._rests] if success.goal_m is not None else ()),
            *([self.landed] if success.landed else ()),
            *([self._crew.succeeded(success.exit)] if success.exit is not None else ()),
        )
        inside = success.corridor_m is None or self.deviation_m <= success.corridor_m
        return all(ends or (self._crew.over,)) and inside


def path_of(folder: Path) -> FloatArray:
    """Read the path (n, 3) of a flight from its run folder, ENU, m.

    Raises:
        RecordError: Its trace cannot be read.
        ConfigError: It has no path.
    """
    trace = read_parquet(RunFolder(folder).trace, "golden trace")
    try:
        path = np.column_stack([trace[name].to_numpy() for name in ("x_m", "y_m", "z_m")])
    except KeyError:
        path = np.zeros((0, 3))
    if len(path) < 2:
        raise ConfigError("the golden flight has no path", key="success.golden")
    return path


def distance_from(place: FloatArray, path: FloatArray) -> float:
    """Return the distance of a place (3,) from a polyline (n, 3), m."""
    begin, along = path[:-1], np.diff(path, axis=0)
    lengths = np.maximum((along**2).sum(axis=1), 1e-12)
    shares = np.clip(((place - begin) * along).sum(axis=1) / lengths, 0.0, 1.0)
    return float(np.sqrt(((begin + shares[:, None] * along - place) ** 2).sum(axis=1)).min())
