"""Simulates vehicle, camera and referee while real firmware flies (`--hil`, `--json`)."""

from __future__ import annotations

import contextlib
import math
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mavfi_cli.core.errors import VehicleProcessError
from mavfi_cli.core.frames import Vector, enu_from_ned, flu_enu_from_frd_ned
from mavfi_cli.link.transport import open_transport
from sitl.autopilot.telemetry import TICK_US, Link
from sitl.camera.component import Camera
from sitl.firmware.ardupilot import ArduPilotLink
from sitl.firmware.autopilot import Boot, FirmwareAutopilot, FirmwareProcess
from sitl.firmware.px4 import Px4Link
from sitl.firmware.sensors import Sensors
from sitl.simulation import Simulation
from sitl.vehicle.profile import VehicleProfile
from sitl.world import World

# The simulator link of each supported firmware.
LINKS: Mapping[str, type[Px4Link | ArduPilotLink]] = {"px4": Px4Link, "ardupilot": ArduPilotLink}

_REMEMBERED_S = 1.0
_POSITION_LIMIT_US = 120_000_000
_START_LIMIT_S, _LOOK_S = 60.0, 0.2


class FirmwareSimulation(Simulation):
    """A simulation in which real firmware commands the rotors at every physics step.

    The firmware's state at a stamp arrives a step or two after the stamp. The camera takes its
    frame from the vehicle's true pose at the stamp of the newest state.

    Args:
        kind: Name of the firmware, a key of LINKS.
        binary: The firmware's SITL program, which is started here and which `close` ends, or None
            if the firmware is started externally.
        seed: Seed of the sensors' noise.
        url: Link to which externally started firmware sends its MAVLink.
        system_id, camera, logs: See `Simulation`.

    Raises:
        LinkError: A port is in use.
        VehicleProcessError: The binary cannot be started.
    """

    awaits_setpoints = False  # ArduPilot accepts none before it follows the companion

    def __init__(
        self,
        world: World,
        profile: VehicleProfile,
        kind: str,
        binary: Path | None,
        *,
        seed: int,
        url: str,
        system_id: int,
        camera: Camera | None = None,
        logs: bool = True,
    ) -> None:
        with contextlib.ExitStack() as undo:
            mavlink = open_transport(url if binary is None else "udpin:127.0.0.1:0")
            undo.callback(mavlink.close)
            self._link = link = LINKS[kind].open(Sensors(seed), ours=binary is not None)
            undo.callback(link.close)
            self._process: FirmwareProcess | None = None
            if binary is not None:
                to_goal = world.goal_enu_m - world.start_enu_m
                boot = Boot(
                    profile=profile,
                    system_id=system_id,
                    mavlink_port=int(mavlink.port),  # type: ignore[attr-defined]
                    heading_deg=math.degrees(math.atan2(to_goal[0], to_goal[1])) % 360.0,
                )
                self._process = link.start(binary, boot)
                undo.callback(self._process.end)
            self._step_us = round(link.step_s * 1e6)
            self._throttles = np.zeros(4)
            self._photographed_us = -1
            self._poses: deque[tuple[int, Vector, Vector]] = deque(
                maxlen=round(_REMEMBERED_S / link.step_s)
            )
            self._firmware = FirmwareAutopilot(mavlink, system_id=system_id, echoes=link.echoes)
            super().__init__(
                world, profile, system_id=system_id, step_s=link.step_s, autopilot=self._firmware,
                camera=camera, logs=logs,
            )  # fmt: skip
            undo.pop_all()

    def begin(self, stopped: Callable[[], bool] = lambda: False) -> None:
        """Wait until the firmware has connected and sends its position, or until stopped.

        Raises VehicleProcessError if the firmware has ended, has sent no position within two
        simulated minutes, or, if we started it, has not connected within a minute.
        """
        self._await_call(stopped)
        autopilot = self._firmware
        while not stopped() and (
            self.stamp_us < self._link.settle_s * 1e6 or autopilot.state_stamp_us < 0
        ):
            if self.stamp_us > _POSITION_LIMIT_US:
                raise VehicleProcessError(
                    "the firmware sent no position within 120 s of simulated time"
                )
            self.advance()
        autopilot.forget()

    def handle(self, message: Any, link: Link) -> None:
        """Queue a client's message for the firmware."""
        self._firmware.handle(message, link)

    def advance(self, between: Callable[[int], None] | None = None) -> None:
        """Simulate one control tick in which the firmware flies. `between` is not called.

        Raises VehicleProcessError, as in `Simulation`. If we started the firmware, the error shows
        the last lines of the firmware's output.
        """
        with self._explained():
            super().advance(between)

    @contextlib.contextmanager
    def _explained(self) -> Iterator[None]:
        try:
            yield
        except VehicleProcessError as error:
            if self._process is None:
                raise
            raise self._process.explain(str(error)) from None

    def close(self) -> None:
        """End the firmware if we started it, and close the links to it."""
        if self._process is not None:
            self._process.end()
        self._firmware.close()
        self._link.close()

    def _await_call(self, stopped: Callable[[], bool]) -> None:
        """Wait until the firmware connects, or until stopped.

        Raises VehicleProcessError if we started the firmware and it ends first, or does not connect
        within a minute.
        """
        deadline_s = time.monotonic() + _START_LIMIT_S
        while not stopped():
            with self._explained():
                if self._link.has_called(_LOOK_S):
                    return
            if self._process is None:
                continue
            self._process.require_running()
            if time.monotonic() > deadline_s:
                raise VehicleProcessError(
                    f"the firmware did not connect within {_START_LIMIT_S:g} s"
                )

    def _fly(self, _between: Callable[[int], None] | None) -> None:
        autopilot = self._firmware
        autopilot.deliver()
        for stamp_us in range(
            self.stamp_us + self._step_us, self.stamp_us + TICK_US + 1, self._step_us
        ):
            throttles = np.zeros(4) if autopilot.terminated else self._throttles
            autopilot.armed = bool(throttles.any())
            if self._wreck is None:
                with self.wall.measure("physics"):
                    self.vehicle.drive(throttles, armed=autopilot.armed)
            truth = self._wreck or self.vehicle.truth
            pose = truth.position_ned_m.copy(), truth.quaternion_frd_ned.copy()
            self._poses.append((stamp_us, *pose))
            with self.wall.measure("firmware"):
                self._throttles = self._link.exchange(stamp_us, truth)

    def _photograph(self, _position_enu_m: Vector, _quaternion_flu_enu: Vector) -> list[Any]:
        stamp_us = self._firmware.state_stamp_us
        if stamp_us <= self._photographed_us or not self._poses:
            return []
        self._photographed_us = stamp_us
        _, position, quaternion = min(self._poses, key=lambda pose: abs(pose[0] - stamp_us))
        return self.camera.poll(
            stamp_us * 1e-6, enu_from_ned(position), flu_enu_from_frd_ned(quaternion)
        )
