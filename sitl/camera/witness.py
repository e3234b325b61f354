"""The referee of a vehicle that somebody else flies: it judges the autopilot's own pose."""

from __future__ import annotations

from collections import deque
from pathlib import Path
from typing import Any

import numpy as np

from mavfi_cli.core.frames import Vector
from mavfi_cli.link.codec import dialect
from sitl.firmware.autopilot import follows_companion
from sitl.referee import Collision, Referee
from sitl.vehicle.profile import VehicleProfile
from sitl.vehicle.vehicle import regression_power
from sitl.world import World

POSE = "the autopilot's own pose"
_ACCELERATION_S = 0.2  # time over which velocities are differentiated
_GROUND = dialect.MAV_LANDED_STATE_ON_GROUND


class Witness:
    """Collision, clearance and energy of a foreign vehicle, as far as its pose tells them.

    The record begins when the vehicle arms. The energy is that of the regression; the power of the
    propellers is not known.

    Args:
        world: World of the flight.
        profile: Stands for the vehicle: its body box and its energy regression.
        logs: Keep a row for each pose, for `save`.
    """

    def __init__(self, world: World, profile: VehicleProfile, *, logs: bool) -> None:
        self._world, self._profile, self._logs = world, profile, logs
        self._coefficients = profile.energy.coefficients(profile.extra_payload_kg)
        self._armed = self._on_ground = False
        self._may_land = True
        self._begin()

    def _begin(self) -> None:
        self._referee = Referee(
            self._world, self._profile.body_box_m, vehicle=self._profile.name, pose=POSE,
            logs=self._logs,
        )  # fmt: skip
        self._velocities: deque[tuple[float, Vector]] = deque()
        self._stamp_s: float | None = None
        self._energy_j = 0.0

    def take(self, message: Any) -> None:
        """Handle a message of the autopilot."""
        if isinstance(message, dialect.MAVLink_heartbeat_message):
            armed = bool(message.base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED)
            if armed and not self._armed:
                self._begin()
            self._armed, self._may_land = armed, not follows_companion(message)
        elif isinstance(message, dialect.MAVLink_extended_sys_state_message):
            self._on_ground = message.landed_state == _GROUND

    def observe(
        self, stamp_s: float, position_enu_m: Vector, quaternion_flu_enu: Vector, velocity: Vector
    ) -> Collision | None:
        """Judge a pose in the world. Return the first collision of a flight, once.

        Args:
            stamp_s: Boot clock of the vehicle.
            position_enu_m: (3,)
            quaternion_flu_enu: (4,)
            velocity: (3,) ENU, m/s.
        """
        if self._stamp_s is not None and stamp_s <= self._stamp_s:
            if stamp_s > self._stamp_s - 1.0:
                return None
            self._begin()  # the autopilot has booted anew
        power_w = self._power_w(stamp_s, velocity)
        if self._stamp_s is not None:
            self._energy_j += power_w * (stamp_s - self._stamp_s)
        self._stamp_s = stamp_s
        return self._referee.observe(
            stamp_s, position_enu_m, quaternion_flu_enu, velocity,
            armed=self._armed, on_ground=self._on_ground, may_land=self._may_land,
            power_regression_w=power_w, power_propeller_w=np.nan,
        )  # fmt: skip

    def _power_w(self, stamp_s: float, velocity: Vector) -> float:
        past = self._velocities
        past.append((stamp_s, velocity))
        while len(past) > 2 and past[1][0] <= stamp_s - _ACCELERATION_S:
            past.popleft()
        since_s = stamp_s - past[0][0]
        acceleration = (velocity - past[0][1]) / since_s if since_s > 0.0 else np.zeros(3)
        if not self._armed:
            return 0.0
        return float(regression_power(velocity, acceleration, self._coefficients))

    def save(self, folder: Path) -> None:
        """Write the referee's log and verdict, if it has seen anything. Raises RecordError."""
        if self._stamp_s is None:
            return
        self._referee.save(folder, {"regression": self._energy_j})
