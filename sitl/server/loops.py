"""The two ways to drive a simulation: in lockstep with one companion, or in real time.

In lockstep, simulated time stands still while the companion computes. Each control tick everything
due goes out in one send that ends with LOCAL_POSITION_NED. The next tick begins when the companion
has sent SET_POSITION_TARGET_LOCAL_NED with the same time_boot_ms. In real time, the wall clock
paces any number of clients.
"""

from __future__ import annotations

import select
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from mavfi_cli.core.errors import LinkLost, VehicleProcessError
from mavfi_cli.link.codec import Signing, dialect
from mavfi_cli.link.transport import Listener, memory_pair
from sitl.autopilot.streams import TICK_US, Preset
from sitl.server.client import Client
from sitl.server.simulation import Simulation

_PATIENCE_S = 0.5
_SETPOINT = dialect.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED
_LOOK_UP_S = 0.2  # interval at which a silent wait checks for a stop


class _Pace:
    """Computes the wait before the next tick.

    A slow machine does not accumulate delay: time lost beyond half a second of delay is
    dropped.

    Args:
        speed: simulated seconds for each second of the wall clock.
    """

    def __init__(self, speed: float) -> None:
        self._speed = speed
        self._due_s = time.monotonic()

    def next_tick(self, tick_s: float) -> None:
        """Count one more simulated tick."""
        self._due_s = max(self._due_s + tick_s / self._speed, time.monotonic() - _PATIENCE_S)

    def remaining_s(self) -> float:
        """Time until the tick is due; zero or less if it is."""
        return self._due_s - time.monotonic()


def run_lockstep(
    simulation: Simulation,
    client: Client,
    *,
    speed: float | None,
    limit_s: float,
    stopped: Callable[[], bool],
) -> None:
    """Run until the companion closes the connection, or until stopped.

    Args:
        simulation: the vehicle.
        client: the companion.
        speed: limit in multiples of real time; None for no limit.
        limit_s: wall time limit of the companion for one tick.
        stopped: whether the user requested the end.

    Raises:
        VehicleProcessError: no answer within the limit.
    """
    pace = None if speed is None else _Pace(speed)
    try:
        while not stopped():
            client.send_tick()
            if not _await_answer(simulation.stamp_us // 1000, client, limit_s, stopped):
                return
            if pace is not None:
                pace.next_tick(TICK_US * 1e-6)
                time.sleep(max(pace.remaining_s(), 0.0))
            simulation.advance()
    except LinkLost:
        return


def _await_answer(
    stamp_ms: int, client: Client, limit_s: float, stopped: Callable[[], bool]
) -> bool:
    """Handle messages of the companion until it answers; False if stopped before."""
    deadline_s = 0.0
    while True:
        messages = client.receive(_LOOK_UP_S)
        if _answers(messages, stamp_ms):
            return True
        if messages:
            deadline_s = 0.0
            continue
        now_s = time.monotonic()
        if stopped():
            return False
        if not deadline_s:
            deadline_s = now_s + limit_s
        elif now_s > deadline_s:
            raise VehicleProcessError(
                f"the companion gave no answer to {stamp_ms} ms within {limit_s:g} s"
            )


def _answers(messages: Sequence[Any], stamp_ms: int) -> bool:
    """Whether the setpoint for a stamp is among the companion's messages."""
    return any(
        message.get_msgId() == _SETPOINT and message.time_boot_ms == stamp_ms
        for message in messages
    )


class EmbeddedVehicle:
    """The vehicle in the process of its companion, which waits while the vehicle flies.

    Args:
        simulation: the vehicle.
        truth_folder: folder in which the truth is saved at the end.

    Attributes:
        link: the companion's end of the link. When the companion has answered a tick and waits for
            more, the vehicle flies the next one.
        error: error that ended the vehicle before its companion.
    """

    def __init__(self, simulation: Simulation, truth_folder: Path) -> None:
        self._simulation = simulation
        self.link, end = memory_pair("the simulated vehicle")
        self._client = Client(simulation, end, Preset.LOCKSTEP)
        self._begun = self._ended = False
        self.truth_folder = truth_folder
        self.error: Exception | None = None
        self.link.on_wait = self._fly_on

    def _fly_on(self) -> None:
        """Fly a tick if the companion has answered the last one, and send its messages."""
        try:
            if not self._begun or self._fly_tick():
                self._begun = True
                self._client.send_tick()
        except Exception as error:  # the vehicle's boundary: the companion only loses its link
            self.error = error
            self.end()

    def _fly_tick(self) -> bool:
        """Fly a tick if the companion has answered; return whether it has."""
        answered = _answers(self._client.receive(0.0), self._simulation.stamp_us // 1000)
        if answered:
            self._simulation.advance()
        return answered

    def end(self) -> None:
        """Fly the companion's last answer and save the truth; may be called repeatedly.

        Raises:
            RecordError: the truth cannot be saved.
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
        self._simulation.save_truth(self.truth_folder)


@dataclass(frozen=True, slots=True, kw_only=True)
class Door:
    """An endpoint for clients, and their preset."""

    listener: Listener
    preset: Preset
    signing: Callable[[], Signing | None]  # a new one for each client
    ends_with_peer: bool = False  # an inherited connection; the server ends with it


class Realtime:
    """The clients of a simulation that is paced by the wall clock."""

    def __init__(self, simulation: Simulation, doors: list[Door], *, speed: float) -> None:
        self._simulation = simulation
        self._doors = doors
        self._pace = _Pace(speed)
        self._clients: list[tuple[Client, Door]] = []
        self._over = False

    def run(self, stopped: Callable[[], bool]) -> None:
        """Run until stopped, or until an inherited connection closes."""
        self._welcome()
        while not stopped() and not self._over:
            self._each(Client.send_tick)
            self._pace.next_tick(TICK_US * 1e-6)
            self._serve(stopped)
            self._simulation.advance()

    def close(self) -> None:
        """Close every client and door."""
        for client, _ in self._clients:
            client.close()
        for door in self._doors:
            door.listener.close()

    def _serve(self, stopped: Callable[[], bool]) -> None:
        """Answer clients until the next tick is due; at least once."""
        while True:
            self._wait(max(self._pace.remaining_s(), 0.0))
            self._welcome()
            self._each(Client.drain)
            self._forward()
            self._each(Client.send_answers)
            if self._pace.remaining_s() <= 0.0 or stopped() or self._over:
                return

    def _forward(self) -> None:
        """Forward the status texts of each client to all others."""
        for speaker, _ in list(self._clients):
            while speaker.overheard:
                frame = speaker.overheard.popleft()
                self._each(partial(_forward, frame, speaker))

    def _wait(self, timeout_s: float) -> None:
        poller = select.poll()
        descriptors = {door.listener.fileno() for door in self._doors}
        descriptors |= {client.transport.fileno() for client, _ in self._clients}
        for descriptor in descriptors:
            if descriptor >= 0:  # a door with one peer closes with it
                poller.register(descriptor, select.POLLIN)
        poller.poll(timeout_s * 1e3)

    def _welcome(self) -> None:
        for door in self._doors:
            for transport in door.listener.accept_ready():
                signing = door.signing()
                client = Client(self._simulation, transport, door.preset, signing=signing)
                self._clients.append((client, door))

    def _each(self, action: Callable[[Client], None]) -> None:
        """Call a function with every client, and remove disconnected ones."""
        for client, door in list(self._clients):
            try:
                action(client)
            except LinkLost:
                client.close()
                self._clients.remove((client, door))
                self._over = self._over or door.ends_with_peer


def _forward(frame: bytes, speaker: Client, client: Client) -> None:
    if client is not speaker:
        client.forward(frame)
