"""Real time: any number of clients, paced by the wall clock."""

from __future__ import annotations

import select
from collections.abc import Callable
from dataclasses import dataclass

from mavfi_cli.core.errors import LinkLost
from mavfi_cli.link.signing import Signing
from mavfi_cli.link.transport import Listener
from sitl.autopilot.streams import TICK_US, Preset
from sitl.server.client import Client
from sitl.server.pace import Pace
from sitl.server.simulation import Simulation

_RECEIVES_A_TICK = 1000  # limit per client, so that a flood cannot stop the clock


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
        self._pace = Pace(speed)
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
            self._each(_drain)
            self._forward()
            self._each(Client.send_answers)
            if self._pace.remaining_s() <= 0.0 or stopped() or self._over:
                return

    def _forward(self) -> None:
        """Forward the status texts of each client to all others."""
        for speaker, _ in list(self._clients):
            while speaker.overheard:
                self._tell_others(speaker, speaker.overheard.popleft())

    def _tell_others(self, speaker: Client, frame: bytes) -> None:
        def forward(client: Client) -> None:
            """Send to all except the sender."""
            if client is not speaker:
                client.forward([frame])

        self._each(forward)

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


def _drain(client: Client) -> None:
    for _ in range(_RECEIVES_A_TICK):
        if not client.receive_some():
            return
