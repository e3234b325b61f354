"""The referee: detects collisions and logs the true state of the vehicle."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.core.errors import VehicleProcessError
from sitl.referee.ground import GroundRule, LandingLimits
from sitl.referee.sweep import clearance, sweep
from sitl.referee.truth import TruthLog, save_truth
from sitl.world import World

Vector = NDArray[np.float64]

_DEFAULT_LIMITS = LandingLimits()


@dataclass(frozen=True, slots=True, kw_only=True)
class Collision:
    """First collision of a flight."""

    stamp_s: float  # time of contact, between two observations
    position_enu_m: tuple[float, float, float]  # vehicle at the time of contact
    speed_mps: float
    box_index: int | None  # None: the ground

    @property
    def what(self) -> str:
        """Name of the obstacle: the ground, or a box with its index."""
        return "ground" if self.box_index is None else f"box {self.box_index}"

    @property
    def text(self) -> str:
        """Return a short line for a status message."""
        place = " ".join(f"{c:.1f}" for c in self.position_enu_m)
        return f"Collision: {self.what} at {place}"


class Referee:
    """Collision, clearance, flown distance and truth log of one flight.

    Args:
        world: World of the flight.
        body_box_m: Length, width and height of the vehicle's body box, centred on its position.
        vehicle: Name of the vehicle, for the report.
        physics: Mass and thrust of the vehicle, for the report.
        limits: Limits of a landing.
    """

    def __init__(
        self,
        world: World,
        body_box_m: Sequence[float],
        *,
        vehicle: str = "",
        physics: Mapping[str, float] | None = None,
        limits: LandingLimits = _DEFAULT_LIMITS,
    ) -> None:
        self.world = world
        self.vehicle = vehicle
        self.physics = dict(physics or {})
        self.collision: Collision | None = None
        self.distance_m = 0.0
        self.min_clearance_m = math.inf
        self.log = TruthLog()
        length, width, height = body_box_m
        self._half = np.array([length, width, height]) / 2.0
        self._boxes = np.array(world.boxes_enu_m)  # writable: one compiled signature
        self._ground = GroundRule(half_m=(length / 2.0, width / 2.0, height / 2.0), limits=limits)
        self._stamp_s = 0.0
        self._position: Vector | None = None
        self._quaternion = level = np.array([1.0, 0.0, 0.0, 0.0])
        # Load the compiled geometry now, so that the first tick does not stall in real time.
        clearance(np.zeros(3), level, self._half, self._boxes)
        sweep(np.zeros(3), level, np.zeros(3), level, self._half, self._boxes, 0.0)

    def observe(
        self,
        stamp_s: float,
        position_enu_m: Vector,
        quaternion_flu_enu: Vector,
        velocity_enu_mps: Vector,
        *,
        armed: bool,
        on_ground: bool,
        may_land: bool = False,
        power_regression_w: float = 0.0,
        power_propeller_w: float = 0.0,
    ) -> Collision | None:
        """Check the motion since the last observation, and log a row of truth.

        Args:
            stamp_s: Simulated time, s.
            position_enu_m: Position of the vehicle (3,).
            quaternion_flu_enu: Unit quaternion (4,) w x y z, body forward-left-up to ENU.
            velocity_enu_mps: Velocity of the vehicle (3,).
            armed: True if the motors may turn.
            on_ground: True if the physics reports ground contact.
            may_land: The flight controller is landing or taking off, so a gentle ground contact is
                not a crash. A disarmed vehicle may always land.
            power_regression_w: Power comparable with the paper's, for the log.
            power_propeller_w: Power of the propellers, for the log.

        Returns:
            First collision of the flight in the call that detects it, otherwise None.

        Raises:
            VehicleProcessError: The state is not finite.
        """
        position = np.array(position_enu_m, dtype=np.float64)
        quaternion = np.array(quaternion_flu_enu, dtype=np.float64)
        found = self.judge(
            stamp_s,
            position,
            quaternion,
            velocity_enu_mps,
            armed=armed,
            on_ground=on_ground,
            may_land=may_land,
        )
        gap, _ = clearance(position, quaternion, self._half, self._boxes)
        self.log.append(
            stamp_s,
            position,
            velocity_enu_mps,
            quaternion,
            gap,
            power_regression_w,
            power_propeller_w,
            armed,
            on_ground,
        )
        return found

    def judge(
        self,
        stamp_s: float,
        position_enu_m: Vector,
        quaternion_flu_enu: Vector,
        velocity_enu_mps: Vector,
        *,
        armed: bool,
        on_ground: bool,
        may_land: bool = False,
    ) -> Collision | None:
        """Check as `observe` without a log row, for the physics steps between control ticks."""
        position = np.array(position_enu_m, dtype=np.float64)
        quaternion = np.array(quaternion_flu_enu, dtype=np.float64)
        if not math.isfinite(float(position.sum() + quaternion.sum())):
            raise VehicleProcessError(f"at {stamp_s:.3f} s the vehicle's state is not finite")
        before, attitude_before, since = self._position, self._quaternion, self._stamp_s
        if before is None:
            before, attitude_before, since = position, quaternion, stamp_s
        self._position, self._quaternion, self._stamp_s = position, quaternion, stamp_s
        if armed:
            self.distance_m += math.dist(before, position)
        crashed = self._ground.crashed(
            position,
            quaternion,
            velocity_enu_mps,
            on_ground=on_ground,
            may_land=may_land or not armed,
        )
        if self.collision is not None:
            return None
        share, box, self.min_clearance_m = sweep(
            before,
            attitude_before,
            position,
            quaternion,
            self._half,
            self._boxes,
            self.min_clearance_m,
        )
        if box < 0 and not crashed:
            return None
        share = share if box >= 0 else 1.0
        place = before + share * (position - before)
        self.collision = Collision(
            stamp_s=since + share * (stamp_s - since),
            position_enu_m=(float(place[0]), float(place[1]), float(place[2])),
            speed_mps=float(np.linalg.norm(velocity_enu_mps)),
            box_index=int(box) if box >= 0 else None,
        )
        return self.collision

    def report(self, energies_j: Mapping[str, float] | None = None) -> dict[str, Any]:
        """Return the result of the flight for JSON. An infinite clearance (no boxes) is None."""
        world, hit = self.world, self.collision
        least = self.min_clearance_m
        return {
            "collision": None
            if hit is None
            else {
                "stamp_s": hit.stamp_s,
                "what": hit.what,
                "box_index": hit.box_index,
                "position_enu_m": list(hit.position_enu_m),
                "speed_mps": hit.speed_mps,
            },
            "min_clearance_m": least if math.isfinite(least) else None,
            "distance_m": self.distance_m,
            "energies_j": dict(energies_j or {}),
            "vehicle": self.vehicle,
            "physics": self.physics,
            "world": {
                "name": world.name,
                "seed": world.seed,
                "boxes": world.boxes_enu_m.tolist(),
                "bounds": world.bounds_enu_m.tolist(),
                "start": world.start_enu_m.tolist(),
                "goal": world.goal_enu_m.tolist(),
            },
        }

    def save(self, folder: Path, energies_j: Mapping[str, float] | None = None) -> None:
        """Write `truth.npz` and `truth.json` into `folder`, each atomically.

        Raises:
            RecordError: The folder cannot be written.
        """
        save_truth(folder, self.log, self.report(energies_j))
