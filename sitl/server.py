"""Serves a simulation in lockstep to one companion, or in real time to any number of clients.

In lockstep, simulated time stands still while the companion computes. At every control tick, all
due messages are sent at once, LOCAL_POSITION_NED last. The next tick begins when the companion has
sent SET_POSITION_TARGET_LOCAL_NED with the same time_boot_ms.
"""

from __future__ import annotations

import contextlib
import sys
import time
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from mavfi_cli.core.compiled import in_cache
from mavfi_cli.core.errors import LinkLost, VehicleProcessError
from mavfi_cli.core.terminal import echo, exit_code, note
from mavfi_cli.core.types import FlightTruth
from mavfi_cli.link.codec import Codec, Signing, dialect
from mavfi_cli.link.endpoint import parse_endpoint
from mavfi_cli.link.peers import Peer, Peers
from mavfi_cli.link.transport import Transport, memory_pair, open_transport, signing_from_file
from sitl.autopilot.autopilot import COMPONENT, Autopilot
from sitl.autopilot.telemetry import STEP_US, TICK_US, Preset
from sitl.camera.component import COMPONENT_ID as CAMERA
from sitl.camera.component import Camera
from sitl.camera.ranges import SENSORS
from sitl.camera.stream import DepthStream
from sitl.command_line import stop_on_signals
from sitl.firmware.simulation import LINKS, FirmwareSimulation
from sitl.options import ServerOptions, VehicleSetup, parse
from sitl.referee import Collision
from sitl.simulation import Simulation
from sitl.vehicle.cascade import control_step
from sitl.vehicle.profile import VehicleProfile, load_profile
from sitl.world import World, load_world

_COMMANDS = (dialect.MAVLINK_MSG_ID_COMMAND_LONG, dialect.MAVLINK_MSG_ID_COMMAND_INT)
_FRAMES = frozenset(
    {
        dialect.MAVLINK_MSG_ID_CAMERA_IMAGE_CAPTURED,
        dialect.MAVLINK_MSG_ID_DATA_TRANSMISSION_HANDSHAKE,
        dialect.MAVLINK_MSG_ID_ENCAPSULATED_DATA,
    }
)
_ON_REQUEST = _FRAMES.union(SENSORS)
_MOST_TEXTS = 10  # newest texts of one client, queued for the others


class Client(Peer):
    """Passes the messages of one client to the simulation, and sends the client its messages.

    A client gets depth frames only after it has started the image capture, and ranges only after it
    has requested them. All clients get the camera's heartbeat.

    Attributes:
        texts: Frames of received STATUSTEXTs, to be forwarded unchanged to the other clients, as
            an autopilot forwards its companion's texts to the ground station.
    """

    def __init__(
        self,
        simulation: Simulation,
        transport: Transport,
        *,
        preset: Preset,
        signing: Signing | None = None,
    ) -> None:
        super().__init__(transport)
        self._simulation = simulation
        self._preset = preset
        self.link = simulation.autopilot.open_link(preset)
        self._codec, self._camera_codec = (
            Codec(simulation.autopilot.system_id, component, signing=signing)
            for component in (COMPONENT, CAMERA)
        )
        self._camera_answers: list[Any] = []
        self._unwanted = _ON_REQUEST  # ids of camera messages that the client has not requested
        self.texts: deque[bytes] = deque(maxlen=_MOST_TEXTS)

    def rejoin(self) -> None:
        """Open a new link with the preset's default streams, after the simulation has restarted."""
        self.link = self._simulation.autopilot.open_link(self._preset)

    def close(self) -> None:
        """Close the autopilot's link and release the connection."""
        self._simulation.autopilot.close_link(self.link)
        super().close()

    def receive(self, timeout_s: float) -> list[Any]:
        """Wait at most `timeout_s` for bytes, and handle the messages in them.

        Return these messages. Raises LinkLost if the client has closed the connection.
        """
        with self._simulation.wall.sample("wait"):
            data = self.transport.receive(timeout_s)
        return self.take(data) if data else []

    def take(self, data: bytes) -> list[Any]:
        """Handle the messages in received bytes. Return these messages."""
        with self._simulation.wall.sample("link"):
            messages = self._codec.decode(data, datagram=self.transport.datagram)
            for message in messages:
                if message.get_msgId() in _COMMANDS:
                    if self._offer_camera(message):
                        continue
                elif message.get_msgId() == dialect.MAVLINK_MSG_ID_STATUSTEXT:
                    self.texts.append(bytes(message.get_msgbuf()))
                self._simulation.handle(message, self.link)
        return messages

    def send_tick(self) -> bool:
        """Send all messages due at this tick at once, the autopilot's streams last.

        Return False if no message is due.
        """
        with self._simulation.wall.sample("link"):
            due = [
                message
                for message in self._simulation.camera_due
                if message.get_msgId() not in self._unwanted
            ]
            return self._send(due, self._simulation.autopilot.collect(self.link))

    def send_between(self, stamp_us: int) -> bool:
        """Send the messages of the fast streams that are due at `stamp_us`, between two ticks.

        Return False if no message is due.
        """
        autopilot = self._simulation.autopilot
        if not (self.link.is_fast and isinstance(autopilot, Autopilot)):
            return False
        return self._send([], autopilot.collect_between(self.link, stamp_us))

    def send_answers(self) -> bool:
        """Send queued answers without waiting for the next tick. Return False if there are none."""
        return self._send([], self.link.take())

    def _send(self, of_camera: list[Any], of_autopilot: list[Any]) -> bool:
        """Send messages of camera and autopilot at once, after the camera's queued answers.

        Return False if there is nothing to send.
        """
        answers, self._camera_answers = self._camera_answers, []
        frames = [self._camera_codec.encode(message) for message in answers + of_camera]
        frames += [self._codec.encode(message) for message in of_autopilot]
        if frames:
            self.transport.send(b"".join(frames))
        return bool(frames)

    def _offer_camera(self, message: Any) -> bool:
        """Offer a command to the camera. Return True if the autopilot is not to get it.

        The camera answers in the autopilot's name if the autopilot is asked for ranges, because
        clients such as MAVSDK ask only the autopilot. Real firmware answers for itself.
        """
        for_autopilot = (
            isinstance(self._simulation.autopilot, Autopilot)
            and (message.target_system, message.target_component) == (self._codec.system, COMPONENT)
            and message.command == dialect.MAV_CMD_SET_MESSAGE_INTERVAL
            and message.param1 in SENSORS
        )
        component = COMPONENT if for_autopilot else CAMERA
        answers = self._simulation.camera.handle(message, component=component)
        if for_autopilot:
            for answer in answers:
                self.link.send(answer)
        else:
            self._camera_answers += answers
        if answers and answers[-1].result == dialect.MAV_RESULT_ACCEPTED:
            self._choose(message)
        return for_autopilot

    def _choose(self, message: Any) -> None:
        """Note which camera messages the client gets after a command that the camera accepted."""
        if message.command == dialect.MAV_CMD_IMAGE_START_CAPTURE:
            self._unwanted -= _FRAMES
        elif message.command == dialect.MAV_CMD_IMAGE_STOP_CAPTURE:
            self._unwanted |= _FRAMES
        elif message.command == dialect.MAV_CMD_SET_MESSAGE_INTERVAL:
            number = {round(message.param1)}
            ends = message.param2 < 0.0
            self._unwanted = self._unwanted | number if ends else self._unwanted - number


_PATIENCE_S = 0.5
_SETPOINT = dialect.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED
_LOOK_UP_S = 0.2  # interval at which a wait checks `stopped`
_LATE_S = 0.25  # delay of a tick beyond which fast streams drop to the tick rate
_SHARE = 0.25  # share of a tick's time that clients get when the tick is overdue


class _Pace:
    """Schedules the ticks on the wall clock, at `speed` times real time.

    On a slow machine, delay does not accumulate: the part beyond half a second is dropped.
    """

    def __init__(self, speed: float) -> None:
        self.speed = speed
        self._due_s = time.monotonic()

    def next_tick(self, tick_s: float) -> None:
        """Schedule the next tick `tick_s` of simulated time after the last one."""
        self._due_s = max(self._due_s + tick_s / self.speed, time.monotonic() - _PATIENCE_S)

    def remaining_s(self) -> float:
        """Return the seconds until the scheduled tick; the result is negative if it is overdue."""
        return self._due_s - time.monotonic()


def _lockstep(options: ServerOptions, simulation: Simulation, stopped: Callable[[], bool]) -> None:
    """Run in lockstep until the companion closes the connection or `stopped` returns True.

    Raises VehicleProcessError if the companion does not answer a tick in time.
    """
    client = Client(simulation, open_transport(f"fd:{options.fd}"), preset=Preset.LOCKSTEP)
    pace = None if options.speed is None else _Pace(options.speed)
    with contextlib.closing(client), contextlib.suppress(LinkLost):
        while not stopped():
            client.send_tick()
            stamp_ms = simulation.stamp_us // 1000
            if not _await_answer(stamp_ms, client, options.answer_limit_s, stopped):
                return
            if pace is not None:
                pace.next_tick(TICK_US * 1e-6)
                time.sleep(max(pace.remaining_s(), 0.0))
            simulation.advance()


def _await_answer(
    stamp_ms: int, client: Client, limit_s: float, stopped: Callable[[], bool]
) -> bool:
    """Handle the companion's messages until it answers the tick at `stamp_ms`.

    Return False if stopped first. Raises VehicleProcessError if the companion does not answer
    within `limit_s`.
    """
    asked_s = time.monotonic()
    while not stopped():
        if _answers(client.receive(_LOOK_UP_S), stamp_ms):
            return True
        if time.monotonic() > asked_s + limit_s:
            raise VehicleProcessError(
                f"the companion did not answer the tick at {stamp_ms} ms within {limit_s:g} s"
            )
    return False


def _answers(messages: Sequence[Any], stamp_ms: int) -> bool:
    setpoints = (message for message in messages if message.get_msgId() == _SETPOINT)
    return any(setpoint.time_boot_ms == stamp_ms for setpoint in setpoints)


class EmbeddedVehicle:
    """Runs the vehicle inside the process of its companion.

    Once the companion has answered a tick and waits for messages, the next tick is simulated.

    Attributes:
        link: The companion's end of the link.
        briefing: Data that the companion gets before its first message.
        error: The error that ended the simulation before its companion, or None.

    Raises:
        MavfiError: The world, the vehicle, the start or the goal cannot be used.
    """

    def __init__(self, setup: VehicleSetup) -> None:
        world, profile = _loaded(setup)
        self.briefing = world.briefing(profile.camera_mount_flu_m)
        self._simulation = simulation = _simulation(setup, world, profile, logs=True)
        self.link, end = memory_pair("the simulated vehicle")
        self._client = Client(simulation, end, preset=Preset.LOCKSTEP)
        self._begun = self._ended = False
        self.error: Exception | None = None
        self.link.on_wait = self._fly_on

    def _fly_on(self) -> None:
        """Simulate a tick if the companion has answered the last one, and send the messages due."""
        try:
            if not self._begun:
                self._simulation.begin()
            if not self._begun or self._fly_tick():
                self._begun = True
                while not self._client.send_tick():
                    self._simulation.advance()
        except Exception as error:  # the vehicle's boundary: the companion only loses its link
            self.error = error
            self.end()

    def _fly_tick(self) -> bool:
        messages, simulation = self._client.receive(0.0), self._simulation
        if simulation.awaits_setpoints and not _answers(messages, simulation.stamp_us // 1000):
            return False
        simulation.advance()
        return True

    def end(self) -> None:
        """Simulate one last tick if the companion has answered the newest one, then close.

        Safe to call more than once.
        """
        if self._ended:
            return
        self._ended = True
        try:
            if self._begun and self.error is None:
                self._fly_tick()
        except Exception as error:  # as above
            self.error = error
        self._client.close()
        self._simulation.close()

    def truth(self) -> FlightTruth:
        """Return the referee's log and verdict so far, and the host's wall times and memory."""
        return self._simulation.truth()


class _Realtime:
    """Serves a simulation, paced by the wall clock, to any number of clients."""

    def __init__(self, options: ServerOptions, simulation: Simulation) -> None:
        self._options = options
        self._simulation = simulation
        self._pace = _Pace(options.speed or 1.0)
        signing = signing_from_file(options.key_file)
        self._clients: Peers[Client] = Peers(signing=signing, allow_unsigned=options.allow_unsigned)
        for preset, url in options.links:  # all share one signing, so no frame is accepted twice
            self._clients.open(url, partial(Client, simulation, preset=preset, signing=signing))
        self._announced: Collision | None = None

    def run(self, stopped: Callable[[], bool]) -> None:
        """Run until `stopped` returns True or an inherited connection closes."""
        self._simulation.begin(stopped)
        if (kind := self._options.setup.firmware_kind) is not None and not stopped():
            note(f"{kind} is ready: clients may connect")
        self._clients.serve(until_s=0.0)
        while not stopped() and not self._clients.over:
            is_fast = self._pace.remaining_s() > -_LATE_S and any(
                client.link.is_fast for client in self._clients
            )
            self._serve(Client.send_tick, STEP_US if is_fast else TICK_US, stopped)
            self._simulation.advance(partial(self._between, stopped=stopped) if is_fast else None)
            collision = self._simulation.referee.collision
            if collision is not None and collision is not self._announced:
                echo(f"{collision.text}; the vehicle stays there until a client reboots it")
            self._announced = collision
            if self._simulation.autopilot.restart_requested:
                self._simulation.restart()
                self._clients.for_all(Client.rejoin)
                echo("restarted")

    def _between(self, stamp_us: int, *, stopped: Callable[[], bool]) -> None:
        """Send the fast streams' messages due at a stamp within a tick, then serve the clients."""
        send = partial(Client.send_between, stamp_us=stamp_us)
        self._serve(send, STEP_US, stopped)

    def close(self) -> None:
        """Close the clients and their endpoints."""
        self._clients.close()

    def _serve(
        self, send: Callable[[Client], bool], duration_us: int, stopped: Callable[[], bool]
    ) -> None:
        """Send the messages that are due, then serve the clients until the next tick or step.

        `duration_us` is the simulated time until then. If the machine is late, the clients are
        served once. The time for all clients is bounded, so that a flood of messages cannot stop
        the clock. Up to half of it goes to sending the due messages.
        """
        self._pace.next_tick(duration_us * 1e-6)
        share_s = _SHARE * duration_us * 1e-6 / self._pace.speed
        now_s = time.monotonic()
        time_s = max(self._pace.remaining_s(), share_s)
        self._clients.send_in_turn(send, now_s + 0.5 * time_s)
        while True:
            self._clients.wait(max(self._pace.remaining_s(), 0.0))
            self._clients.serve(now_s + time_s)
            self._forward(now_s + time_s)
            self._clients.send_in_turn(Client.send_answers)
            if self._pace.remaining_s() <= 0.0 or stopped() or self._clients.over:
                break

    def _forward(self, until_s: float) -> None:
        for sender in self._clients:
            while sender.texts and time.monotonic() < until_s:
                forward = partial(Client.forward, frame=sender.texts.popleft(), sender=sender)
                self._clients.send_in_turn(forward)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `python -m sitl`. Return its exit code."""
    given = sys.argv[1:] if arguments is None else arguments
    return exit_code(lambda: _serve(parse(given)))


def _serve(options: ServerOptions) -> None:
    """Serve a simulation until the peer disconnects, or SIGINT or SIGTERM arrives.

    If the options name a folder for the truth, it is saved there even after an error.
    """
    stopped = stop_on_signals()
    world, profile = _loaded(options.setup)
    if not options.lockstep and not in_cache(control_step):
        note("the first start compiles the vehicle, about half a minute")
        warm_up()
    if options.truth is not None:
        world.write_briefing(profile.camera_mount_flu_m, options.truth)
    logs = options.truth is not None
    with DepthStream.opened(options.setup.depth, options.setup.camera_size) as depth:
        simulation = _simulation(options.setup, world, profile, logs=logs, depth=depth)
        try:
            if options.lockstep:
                _lockstep(options, simulation, stopped)
            else:
                with contextlib.closing(_Realtime(options, simulation)) as server:
                    _announce(options, simulation)
                    server.run(stopped)
        finally:
            simulation.close()
            if options.truth is not None:
                simulation.save_truth(options.truth)


def warm_up() -> None:
    """Load or compile the code that a flight runs. The code is the same for every world."""
    simulation = Simulation(load_world("dense", seed=1), load_profile("solo"))
    for _ in range(2):
        simulation.advance()


def _loaded(setup: VehicleSetup) -> tuple[World, VehicleProfile]:
    places = {"start_enu_m": setup.start_enu_m, "goal_enu_m": setup.goal_enu_m}
    return load_world(setup.world, seed=setup.seed, **places), load_profile(setup.vehicle)


def _simulation(
    setup: VehicleSetup,
    world: World,
    profile: VehicleProfile,
    *,
    logs: bool,
    depth: DepthStream | None = None,
) -> Simulation:
    columns, rows = setup.camera_size
    camera = Camera(
        world.boxes_enu_m, columns=columns, rows=rows, rate_hz=setup.camera_rate_hz,
        heartbeat_hz=setup.camera_heartbeat_hz, system=setup.system_id,
        mount_offset_flu_m=profile.camera_mount_flu_m, depth=depth,
    )  # fmt: skip
    if setup.firmware_kind is None:
        return Simulation(
            world, profile, camera=camera, system_id=setup.system_id, logs=logs,
            trusted=setup.trusted,
        )  # fmt: skip
    return FirmwareSimulation(
        world, profile, setup.firmware_kind, setup.firmware, seed=setup.firmware_seed,
        url=setup.firmware_link, camera=camera, system_id=setup.system_id, logs=logs,
    )  # fmt: skip


# URL schemes with which MAVSDK and MAVProxy connect to an endpoint, by the endpoint's scheme.
_CALLERS = {
    "udpout": ("udpin", "udpin"), "udpin": ("udpout", "udpout"), "tcpin": ("tcpout", "tcp"),
}  # fmt: skip


def _announce(options: ServerOptions, simulation: Simulation) -> None:
    world = simulation.referee.world
    links = []
    for preset, url in options.links:
        first, *rest = _clients_of(url) or [""]
        links += [f"  {preset.value:9} {url:32} {first}", *(f"{'':45}{line}" for line in rest)]
    source = "anyone" + ("" if options.key_file is None else " who signs")
    if options.setup.trusted:
        source = f"system {', '.join(map(str, sorted(options.setup.trusted)))} only"
    note(
        f"world {world.name} seed {world.seed}, vehicle {simulation.referee.vehicle}, "
        f"system {options.setup.system_id}, {options.speed:g} x real time"
    )
    note(f"takes commands from {source}")
    for line in [*links, *_firmware_settings(options), "Ctrl-C ends it."]:
        note(line.rstrip())


def _firmware_settings(options: ServerOptions) -> list[str]:
    """Return lines of text with the settings that externally started firmware needs.

    The list is empty if we start the firmware ourselves, or use no firmware.
    """
    kind = options.setup.firmware_kind
    if kind is None or options.setup.firmware is not None:
        return []
    parameters = LINKS[kind].parameters(load_profile(options.setup.vehicle))
    return [
        f"waits for {kind}, which sends its MAVLink to {options.setup.firmware_link} "
        "and needs these parameters:",
        *(f"  {name} {value:.6g}" for name, value in parameters.items()),
    ]


def _clients_of(url: str) -> list[str]:
    """Return a line for each known client program, with the option that connects it to a URL.

    The list is empty if these programs cannot connect to this kind of URL.
    """
    at = parse_endpoint(url)
    if at.scheme not in _CALLERS:
        return []
    mavsdk, mavproxy = _CALLERS[at.scheme]
    place = f"[{at.host}]:{at.port}" if ":" in at.host else f"{at.host}:{at.port}"
    alone = ["QGroundControl by itself"] if (at.scheme, at.port) == ("udpout", 14550) else []
    return [f"MAVSDK    {mavsdk}://{place}", f"MAVProxy  --master={mavproxy}:{place}", *alone]
