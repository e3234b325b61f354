"""Vehicle, camera and referee of a flight that real firmware flies."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np

from mavfi_cli.core.errors import VehicleProcessError
from mavfi_cli.core.frames import Vector, enu_from_ned, flu_enu_from_frd_ned
from sitl.autopilot.streams import TICK_US
from sitl.firmware.start import Firmware
from sitl.server.simulation import Simulation
from sitl.vehicle.profile import VehicleProfile
from sitl.world import World

_REMEMBERED_S = 1.0
_POSITION_LIMIT_US = 120_000_000


class FirmwareSimulation(Simulation):
    """A simulation whose rotors a firmware commands, one exchange for each physics step.

    The firmware's state at a stamp comes a step or two after the stamp. The camera takes its frame
    from where the vehicle truly was at the stamp of the newest state.

    Args:
        world: World of the flight.
        profile: Profile of the vehicle.
        firmware: The firmware, which `close` ends.
        options: Further arguments of `Simulation`.
    """

    awaits_setpoints = False  # ArduPilot takes none before it follows the companion

    def __init__(
        self, world: World, profile: VehicleProfile, firmware: Firmware, **options: Any
    ) -> None:
        self._firmware = firmware
        self._link = link = firmware.link
        self._step_us = round(link.step_s * 1e6)
        self._throttles = np.zeros(4)
        self._photographed_us = -1
        self._poses: deque[tuple[int, Vector, Vector]] = deque(
            maxlen=round(_REMEMBERED_S / link.step_s)
        )
        super().__init__(
            world, profile, step_s=link.step_s, autopilot=firmware.autopilot, **options
        )

    def begin(self, stopped: Callable[[], bool] = lambda: False) -> None:
        """Wait until the firmware calls and knows where it is, or until stopped.

        Raises:
            VehicleProcessError: It has ended, did not call within a minute, or gave no position.
        """
        self._firmware.wait(stopped)
        autopilot = self._firmware.autopilot
        while not stopped() and (
            self.stamp_us < self._link.settle_s * 1e6 or autopilot.state_stamp_us < 0
        ):
            if self.stamp_us > _POSITION_LIMIT_US:
                raise VehicleProcessError("the firmware gave no position within 120 s")
            self.advance()
        autopilot.forget()

    def close(self) -> None:
        """End the firmware."""
        self._firmware.close()

    def _fly(self, _between: Callable[[int], None] | None) -> None:
        autopilot = self._firmware.autopilot
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
        stamp_us = self._firmware.autopilot.state_stamp_us
        if stamp_us <= self._photographed_us or not self._poses:
            return []
        self._photographed_us = stamp_us
        _, position, quaternion = min(self._poses, key=lambda pose: abs(pose[0] - stamp_us))
        return self.camera.poll(
            stamp_us * 1e-6, enu_from_ned(position), flu_enu_from_frd_ned(quaternion)
        )
