"""The loop of one mission: receives messages, runs a control tick per state, sends setpoints.

The vehicle provides the clock: every LOCAL_POSITION_NED starts the control tick of its stamp. In
lockstep the vehicle waits for the setpoint of that stamp. The setpoint is sent before the heavy
kernels run, so that a vehicle in its own process can simulate the next tick meanwhile.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from mavfi_cli.autonomy.pilot import TURN_S, PilotMode
from mavfi_cli.companion.executor import Executor
from mavfi_cli.companion.injection import NoInjection
from mavfi_cli.companion.node_process import NodeProcess
from mavfi_cli.companion.pipeline import Companion, CompanionParts
from mavfi_cli.companion.protection import NoProtection, Protection
from mavfi_cli.core.errors import (
    CommandRefused,
    Interrupted,
    LinkLost,
    NoAutopilot,
)
from mavfi_cli.core.frames import norm
from mavfi_cli.core.types import Briefing, FloatArray, Outcome, VehicleState
from mavfi_cli.core.wall import WallClock
from mavfi_cli.link.codec import dialect
from mavfi_cli.link.images import IMAGE_MESSAGES, ImageFrame, ImageReceiver
from mavfi_cli.link.session import OffboardSession, Phase, SessionSettings
from mavfi_cli.link.telemetry import AUTOPILOT, CAMERA, Telemetry
from mavfi_cli.link.tlog import RecordedLink
from mavfi_cli.link.transport import Transport, signing_from_file
from mavfi_cli.mission.progress import FlightLogger, Recorder, Watcher
from mavfi_cli.mission.run_folder import Trace
from mavfi_cli.spec.mission import OWN_AUTOPILOT, MissionConfig

SILENCE_S = 60.0  # time without a message after which a lockstep vehicle counts as lost
BOOT_S = 300.0  # the same for real firmware, which may boot in wall-clock time
IDLE_S = 0.1  # period of messages to a silent foreign autopilot
CAMERA_BELOW_M = 1.0  # the camera starts this far below the take-off height
_WAITING_FRAMES = 16  # newest frames kept until the companion flies
_POSITION = dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED
SYSTEM_ID, COMPONENT_ID = 1, dialect.MAV_COMP_ID_ONBOARD_COMPUTER
_PACE_AFTER_S = 1.0  # wall time after which a foreign vehicle's pace is estimated
_LAND_AFTER = (Outcome.SUCCESS, Outcome.NO_PATH, Outcome.TIMEOUT, Outcome.INTERRUPTED)


class ForeignClock:
    """Estimates a foreign vehicle's time from the stamps of its states and the wall clock.

    Between two states, the vehicle's clock is assumed to run at its average pace in the flight so
    far, but no faster than the wall clock. A simulator may be slower than real time.

    Args:
        wall: Returns wall-clock time, s.

    Attributes:
        stamp_s: Stamp of the newest state; 0 before the first.
        heard: True once a state has arrived.
    """

    def __init__(self, wall: Callable[[], float] = time.monotonic) -> None:
        self._wall = wall
        self._first = (0.0, 0.0)  # stamp and wall time of the first state
        self._waited_s = 0.0
        self._pace = 1.0
        self._doubted_s = math.inf
        self.stamp_s = 0.0
        self.heard = False

    def believes(self, stamp_s: float, limit_s: float) -> bool:
        """Return False if the stamp of a state is not plausible.

        A stamp must be newer than that of the newest state, by at most `limit_s`. A jump beyond
        this limit is accepted as a new clock if the stamp of the next state follows within the
        limit.
        """
        leaps = stamp_s > self.stamp_s + limit_s
        follows = self._doubted_s < stamp_s <= self._doubted_s + limit_s
        self._doubted_s = stamp_s if leaps else math.inf
        return follows or (self.stamp_s < stamp_s and not leaps)

    def hear(self, stamp_s: float) -> None:
        """Set the clock to the stamp of a new state."""
        now_s = self._wall()
        if not self.heard or stamp_s < self.stamp_s:
            self.heard, self._first, self._pace = True, (stamp_s, now_s), 1.0
        self.stamp_s, self._waited_s = stamp_s, 0.0
        flown_s, passed_s = stamp_s - self._first[0], now_s - self._first[1]
        if passed_s >= _PACE_AFTER_S:
            self._pace = min(1.0, flown_s / passed_s)

    def wait(self, waited_s: float) -> None:
        """Add wall-clock time that has passed without a new state."""
        self._waited_s += waited_s

    @property
    def silence_s(self) -> float:
        """Estimated vehicle time since the newest state, in seconds.

        It is at most the wall-clock time since that state.
        """
        return self._waited_s * self._pace

    @property
    def now_s(self) -> float:
        """The time on the vehicle's clock now, estimated in seconds."""
        return self.stamp_s + self.silence_s


class Flight:
    """One mission on one link, from the first heartbeat to its outcome."""

    def __init__(
        self,
        config: MissionConfig,
        parts: CompanionParts,
        transport: Transport,
        watcher: Watcher,
        interrupts: Sequence[int],
        injection: NoInjection,
    ) -> None:
        self._config = config
        self._parts, self.stack = parts, parts.stack
        self._interrupts = interrupts
        self.link = RecordedLink(
            transport,
            SYSTEM_ID,
            COMPONENT_ID,
            signing=signing_from_file(config.key_file),
            clock=None if config.link is None else time.time,
        )
        self._session = self._new_session()
        self.images = ImageReceiver()
        self._frames: deque[ImageFrame] = deque(maxlen=_WAITING_FRAMES)
        self._camera_called = False
        self._seen_s = 0.0  # when the newest frame arrived, or frames were requested
        self._clock = None if config.link is None else ForeignClock()
        self._unspoken_s = 0.0
        self._patience_s = SILENCE_S if config.autopilot == OWN_AUTOPILOT else BOOT_S
        self._briefing: Briefing | None = None
        self.companion: Companion | None = None
        self.injection = injection
        self.logger = FlightLogger(watcher)
        self.trace = Trace()
        self.wall = WallClock()
        self.stamp_s = self.begun_s = 0.0  # current stamp, and that of the first state
        self.takeover_s = float("inf")
        self.end_s = 0.0
        self.outcome: Outcome | None = None
        self.reason = ""
        self._lands = self._landing = False

    def _new_session(self, telemetry: Telemetry | None = None) -> OffboardSession:
        settings = SessionSettings(
            takeoff_height_m=self._config.takeoff_height_m,
            request_streams=self._config.link is not None,
            needs_camera=self._config.link is not None,
        )
        url = self._config.link or "the simulated vehicle"
        return OffboardSession(settings, url=url, telemetry=telemetry)

    @property
    def place_enu_m(self) -> FloatArray:
        """Position of the vehicle, of shape (3,), in metres. Available after `connect`."""
        assert self._session.state is not None
        return self._session.state.position_enu_m

    # Before and after -----------------------------------------------------------------------------

    def connect(self) -> None:
        """Wait for the autopilot's first heartbeat.

        Raises:
            NoAutopilot: No heartbeat arrived.
            LinkLost: The other end closed the connection, or the simulated vehicle is silent.
            Interrupted: The user pressed Ctrl-C before the flight.
        """
        while self._session.phase is Phase.CONNECTING:
            if self._interrupts:
                raise Interrupted("interrupted before the flight began")
            self._turn()
        if self._session.failure is not None:
            raise self._session.failure

    def brief(self, briefing: Briefing, recorder: Recorder | None) -> Companion:
        """Store the briefing, draw the fault, and create and return the companion.

        Args:
            recorder: Records the briefing and the inputs of the nodes.
        """
        config, protection = self._config, NoProtection()
        config.require_flyable(briefing, self.stack.goal_tolerance_m)
        self._briefing = briefing
        if config.detector is not None:
            protection = Protection(config.detector, config.stack, self.wall)
        self.injection.aim(self._shortest_flight_s(briefing), protection)
        self.companion = Companion(
            config, self._parts, briefing, self.wall, self.injection, protection
        )
        if recorder is not None:
            recorder.briefing = briefing
            self.companion.executor.on_start = recorder.on_start
        return self.companion

    def take(self, config: MissionConfig, tlog: Path) -> None:
        """Continue the flight, in a fork of its process, as another mission with its own tlog."""
        self._config = config
        self.link.continue_in(tlog)
        self.lose_nodes_as(config)

    def lose_nodes_as(self, config: MissionConfig) -> None:
        """Use the restart and watchdog times of another mission when a node is lost."""
        if self.companion is not None:
            executor = self.companion.executor
            executor.restart_s = config.node_restart_s
            executor.watchdog_s = config.node_watchdog_s

    def isolate_late(self, name: str, process: NodeProcess | None = None) -> Executor:
        """Move a node that has already run to its own process. Return the executor.

        If that process is lost, the node restarts with fresh state.

        Args:
            process: Process that runs the node, as for `Executor.isolate`.
        """
        assert self.companion is not None
        assert self._briefing is not None
        fresh = Companion(
            self._config, self._parts, self._briefing, WallClock(), NoInjection(), NoProtection()
        )
        self.companion.isolate_late(name, fresh, process)
        return self.companion.executor

    def _shortest_flight_s(self, briefing: Briefing) -> float:
        """Return a lower bound, in seconds, on the flight time from take-over to the goal."""
        takeoff = np.add(briefing.start_enu_m, (0.0, 0.0, self._config.takeoff_height_m))
        way_m = norm(briefing.goal_enu_m - takeoff) - self.stack.goal_tolerance_m
        turn_s = TURN_S if self.stack.turns_before_departure else 0.0
        return max(0.0, way_m) / self._config.v_max_mps + turn_s

    @contextlib.contextmanager
    def isolated_nodes(self) -> Iterator[None]:
        """Run each isolated node in a process of its own during the context."""
        assert self.companion is not None
        assert self._briefing is not None
        executor = self.companion.executor
        try:
            self.injection.arm(executor, self._config, self._briefing)
            for name in self._config.isolate:
                if executor.nodes[name].process is None:
                    executor.isolate(name)
            yield
            if not self._interrupts:
                executor.settle()
        finally:
            executor.close()

    def fly(self, tlog: Path) -> None:
        """Fly until the mission has an outcome.

        Raises:
            CommandRefused: The autopilot refused to arm or to take off.
            RecordError: The tlog could not be written.
        """
        with self.link.recording(tlog):
            try:
                while not self._finished():
                    self._turn()
                    self._judge()
            except LinkLost as error:
                self.end(Outcome.LINK_LOST, str(error))
            finally:
                self.end_s = self.stamp_s if self.outcome is None else self.end_s

    def _finished(self) -> bool:
        """Return True once there is an outcome and any required landing is complete.

        A command refused in the air ends the mission with a landing. Other failures of the session
        are raised.
        """
        failure = self._session.failure
        if failure is not None and self.outcome is None:
            if not (isinstance(failure, CommandRefused) and self._session.is_up):
                raise failure
            self.end(Outcome.FAILSAFE, str(failure), lands=True)
        if self.outcome is None:
            return False
        if not (self._config.land and self._lands) or len(self._interrupts) > 1:
            return True
        if not self._landing:
            self._landing = True
            self._session.request_land()
        elif self._session.phase is Phase.FAILED:
            self.logger.note(self.stamp_s, "autopilot", str(failure), self._session.state)
        return self._session.phase in (Phase.DONE, Phase.FAILED)

    def end(self, outcome: Outcome, reason: str = "", *, lands: bool = False) -> None:
        """Set the outcome of the mission. Later calls have no effect.

        Args:
            lands: Land even if the outcome does not require it, as the vehicle still responds.
        """
        if self.outcome is not None:
            return
        self.outcome, self.reason, self.end_s = outcome, reason, self.stamp_s
        self._lands = lands or outcome in _LAND_AFTER
        text = outcome.value.replace("_", " ") + (f": {reason}" if reason else "")
        self.logger.note(self.stamp_s, "outcome", text, self._session.state)

    def explain(self, why: str) -> None:
        """If the link was lost, append the failure of the vehicle's process to the reason."""
        if self.outcome is Outcome.LINK_LOST:
            self.reason = f"{self.reason}: {why}"

    # One iteration of the loop --------------------------------------------------------------------

    def _turn(self) -> None:
        """Receive messages, and run the control tick of the newest state among them."""
        self.wall.begin_tick()
        if self._clock is not None:
            self._turn_by_wall(self._clock)
        elif data := self._receive(self._patience_s):
            self._tick(self._take(data))
        else:
            raise LinkLost(f"the simulated vehicle sent nothing for {self._patience_s:g} s")

    def _turn_by_wall(self, clock: ForeignClock) -> None:
        """Receive messages of a foreign autopilot, and run the control tick of its newest state.

        If no new state has arrived, send idle messages instead.
        """
        begun_s = time.monotonic()
        data = self._receive(IDLE_S)
        waited_s = time.monotonic() - begun_s
        stamp_s = self._take(data) if data else None
        if self._session.telemetry.heard and self.link.rivals:
            self._session.telemetry.unfit = self.link.rivals
        if stamp_s is not None and not clock.heard:  # adopt its clock, and restart the session
            self.begun_s = self._session.telemetry.now_s = stamp_s
            self._session = self._new_session(self._session.telemetry)
        if self._tick(stamp_s):
            clock.hear(self.stamp_s)
            self._unspoken_s = 0.0
        else:
            self._go_without(clock, waited_s)

    def _receive(self, timeout_s: float) -> bytes:
        with self.wall.sample("wait"):
            return self.link.receive(timeout_s)

    def _take(self, data: bytes) -> float | None:
        """Handle the messages in `data`. Return the newest state's stamp in seconds, if any."""
        newest_s, telemetry = None, self._session.telemetry
        with self.wall.sample("link"):
            for message in self.link.messages(data, self.stamp_s):
                number = type(message).id
                if number in IMAGE_MESSAGES:  # the most frequent ones
                    if telemetry.is_from(message, CAMERA) and (frames := self.images.feed(message)):
                        self._frames += frames
                        self._seen_s = self.stamp_s
                    continue
                if number == _POSITION and telemetry.is_from(message, AUTOPILOT):
                    stamp_s = message.time_boot_ms / 1e3
                    if not self._believes(stamp_s):
                        continue
                    newest_s = stamp_s
                self._session.handle(message)
        return newest_s

    def _believes(self, stamp_s: float) -> bool:
        """Return False for a stamp that is implausible for a foreign vehicle in flight."""
        if self._clock is None or not self._airborne():
            return True
        return self._clock.believes(stamp_s, self._config.loss_limit_s)

    def _go_without(self, clock: ForeignClock, waited_s: float) -> None:
        clock.wait(waited_s)
        self._unspoken_s += waited_s
        limit_s = self._config.loss_limit_s
        if clock.heard and clock.silence_s >= limit_s:
            raise LinkLost(f"{self._config.link}: no new state for {limit_s:g} s")
        if self._unspoken_s < IDLE_S:
            return
        self._unspoken_s = 0.0
        self.link.send(self._session.tick(clock.now_s), clock.now_s)
        if isinstance(self._session.failure, NoAutopilot):
            raise self._session.failure

    def _tick(self, stamp_s: float | None) -> bool:
        """Run one control tick: publish due outputs, decide, send the setpoint, then compute.

        Returns False and does nothing if there is no new stamp.
        """
        if stamp_s is None or (stamp_s <= self.stamp_s and len(self.trace)):
            return False
        self.stamp_s = stamp_s
        state, companion = self._session.state, self.companion
        if companion is not None:
            companion.executor.advance(stamp_s)
        if companion is not None and state is not None and self._airborne():
            self._offer_frames(companion)
            with self.wall.sample("pilot"):
                self._control(stamp_s, state, companion)
        with self.wall.sample("link"):
            self.link.send(self._session.tick(stamp_s), stamp_s)
        if companion is not None:
            companion.executor.compute()
        if not self._camera_called and self._nearly_up(state):
            self._camera_called = True
            self._seen_s = stamp_s
            self._session.start_camera(1.0 / self._config.camera_rate_hz)
        self.logger.log_tick(stamp_s, self._session, companion, self.injection)
        return True

    def _nearly_up(self, state: VehicleState | None) -> bool:
        """Return True near the take-off height, early enough for a map at the take-over."""
        if self._session.phase is Phase.OFFBOARD:
            return True
        height_m = -1.0 if state is None else float(state.position_enu_m[2])
        return self._airborne() and height_m >= self._config.takeoff_height_m - CAMERA_BELOW_M

    def _airborne(self) -> bool:
        return self._session.phase in (Phase.TAKING_OFF, Phase.OFFBOARD, Phase.LANDING)

    def _control(self, stamp_s: float, state: VehicleState, companion: Companion) -> None:
        if self._session.phase is not Phase.OFFBOARD or self.outcome is not None:
            self._session.hold()
            return
        if self.takeover_s > stamp_s:
            self.takeover_s = stamp_s
        command = companion.tick(state)
        if command is not None:
            self._session.set_target(
                command.velocity_enu_mps.tolist(),
                command.yaw_rad,
                command.acceleration_enu_mps2.tolist(),
            )
        self.trace.add(
            stamp_s, companion.pilot.mode.value, state, companion.report, companion.tracked, command
        )

    def _offer_frames(self, companion: Companion) -> None:
        """Pass the newest depth frames and their camera poses to perception."""
        assert self._briefing is not None
        for image in self._frames:
            pose = self._session.state_at(image.stamp_s)
            if pose is not None:
                companion.take_frame(
                    image.depth_frame(
                        pose,
                        hfov_rad=self._briefing.hfov_rad,
                        mount_offset_flu_m=self._briefing.camera_offset_flu_m,
                    )
                )
        self._frames.clear()

    # Outcome --------------------------------------------------------------------------------------

    def _judge(self) -> None:
        if self.outcome is not None:
            return
        session, companion = self._session, self.companion
        if self._interrupts:
            self.end(Outcome.INTERRUPTED)
        elif session.telemetry.collision_text is not None:
            what = session.telemetry.collision_text.removeprefix("Collision: ")
            self.end(Outcome.COLLISION, what, lands=self._config.link is not None)
        elif session.failsafe_text is not None:
            self.end(Outcome.FAILSAFE, session.failsafe_text)
        elif self._blind_s >= self._config.loss_limit_s:
            limit_s = self._config.loss_limit_s
            self.end(Outcome.LINK_LOST, f"the camera sent no frame for {limit_s:g} s", lands=True)
        elif companion is not None and companion.pilot.mode is PilotMode.ARRIVED:
            self.end(Outcome.SUCCESS)
        elif companion is not None and companion.pilot.mode is PilotMode.GAVE_UP:
            self.end(
                Outcome.NO_PATH, f"{companion.pilot.params.attempts_max} plans in a row failed"
            )
        elif self.stamp_s - self.takeover_s >= self._config.time_limit_s:
            self.end(Outcome.TIMEOUT, f"{self._config.time_limit_s:g} s")

    @property
    def _blind_s(self) -> float:
        """Time, in seconds, by which the next frame of a foreign autopilot's camera is overdue.

        It is negative if the frame is not due yet, and 0 if no frame is expected.
        """
        if not self._camera_called or self._config.link is None:
            return 0.0
        return self.stamp_s - self._seen_s - 1.0 / self._config.camera_rate_hz
