"""One client: its connection, codecs, and sessions with autopilot and camera."""

from __future__ import annotations

from collections import deque
from typing import Any

from mavfi_cli.link.codec import Codec, Signing, dialect
from mavfi_cli.link.transport import Transport
from sitl.autopilot.autopilot import COMPONENT, Autopilot
from sitl.autopilot.streams import Preset
from sitl.camera.component import COMPONENT_ID as CAMERA
from sitl.peers import Peer
from sitl.server.simulation import Simulation

_COMMANDS = (dialect.MAVLINK_MSG_ID_COMMAND_LONG, dialect.MAVLINK_MSG_ID_COMMAND_INT)
_FRAMES = (
    dialect.MAVLINK_MSG_ID_CAMERA_IMAGE_CAPTURED,
    dialect.MAVLINK_MSG_ID_DATA_TRANSMISSION_HANDSHAKE,
    dialect.MAVLINK_MSG_ID_ENCAPSULATED_DATA,
)
_OVERHEARD = 10  # number of newest texts to keep


class Client(Peer):
    """Turns bytes of one connection into calls of the simulation, and messages into bytes.

    Depth frames go to the clients that started the capture. All clients get the camera's
    heartbeat.

    Attributes:
        overheard: Frames of received STATUSTEXTs for the other clients, unchanged, as an
            autopilot forwards its companion's texts to the ground station.
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
        self._link = simulation.autopilot.open_link(preset)
        system = simulation.autopilot.system_id
        self._codec = Codec(system, COMPONENT, signing=signing)
        self._camera_codec = Codec(system, CAMERA, signing=signing)
        self._camera_answers: list[Any] = []
        self._wants_frames = False
        self.overheard: deque[bytes] = deque(maxlen=_OVERHEARD)

    def rejoin(self) -> None:
        """Begin again with the preset's streams, after the simulation has restarted."""
        self._link = self._simulation.autopilot.open_link(self._preset)

    def close(self) -> None:
        """Leave the autopilot and release the connection."""
        self._simulation.autopilot.close_link(self._link)
        super().close()

    def receive(self, timeout_s: float) -> list[Any]:
        """Handle the next bytes, waiting at most `timeout_s`. Return the handled messages.

        Raises:
            LinkLost: The peer is gone.
        """
        with self._simulation.wall.measure("wait"):
            data = self.transport.receive(timeout_s)
        return self.take(data) if data else []

    def take(self, data: bytes) -> list[Any]:
        """Handle received bytes. Return the handled messages."""
        with self._simulation.wall.measure("link"):
            messages = self._codec.decode(data, datagram=self.transport.datagram)
            for message in messages:
                if message.get_msgId() in _COMMANDS:
                    self._offer_camera(message)
                elif message.get_msgId() == dialect.MAVLINK_MSG_ID_STATUSTEXT:
                    self.overheard.append(bytes(message.get_msgbuf()))
                self._simulation.autopilot.handle(message, self._link)
        return messages

    def send_tick(self) -> bool:
        """Send everything due at this tick at once, the autopilot's streams last.

        Returns:
            True if anything was due.
        """
        with self._simulation.wall.measure("link"):
            due = [
                message
                for message in self._simulation.camera_due
                if self._wants_frames or message.get_msgId() not in _FRAMES
            ]
            return self._send(due, self._simulation.autopilot.collect(self._link))

    def send_between(self, stamp_us: int) -> None:
        """Send the streams that are faster than a tick, at a stamp between two ticks."""
        autopilot = self._simulation.autopilot
        if self._link.is_fast and isinstance(autopilot, Autopilot):
            self._send([], autopilot.collect_between(self._link, stamp_us))

    @property
    def is_fast(self) -> bool:
        """True if the client has asked for more than one message a tick."""
        return self._link.is_fast

    def send_answers(self) -> None:
        """Send answers without waiting for the tick."""
        self._send([], self._simulation.autopilot.take_outbox(self._link))

    def _send(self, of_camera: list[Any], of_autopilot: list[Any]) -> bool:
        """Send messages of both components; the camera's answers are the first."""
        answers, self._camera_answers = self._camera_answers, []
        frames = [self._camera_codec.encode(message) for message in answers + of_camera]
        frames += [self._codec.encode(message) for message in of_autopilot]
        if frames:
            self.transport.send(b"".join(frames))
        return bool(frames)

    def _offer_camera(self, message: Any) -> None:
        answers = self._simulation.camera.handle(message)
        if not answers:
            return
        self._camera_answers += answers
        if answers[-1].result != dialect.MAV_RESULT_ACCEPTED:
            return
        if message.command == dialect.MAV_CMD_IMAGE_START_CAPTURE:
            self._wants_frames = True
        elif message.command == dialect.MAV_CMD_IMAGE_STOP_CAPTURE:
            self._wants_frames = False
