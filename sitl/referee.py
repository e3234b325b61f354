"""The referee: detects collisions and logs the true state of the vehicle."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mavfi_cli.core.errors import VehicleProcessError
from mavfi_cli.core.files import write_atomically, write_json, writing
from mavfi_cli.core.frames import Vector, norm
from sitl.sweep import clearance, sweep
from sitl.world.world import World

# Columns of truth.npz, (n,) or (n, 3 or 4), one row per control tick.
_COLUMNS = (
    "stamp_s", "position_enu_m", "velocity_enu_mps",
    "quaternion",  # w x y z, body FLU -> ENU
    "clearance_m", "power_regression_w", "power_propeller_w", "armed", "on_ground",
)  # fmt: skip

# Limits of a landing. They allow a hard landing on level legs, but neither a fall nor a touchdown
# at cruise speed. PX4 lands at 0.7 m/s (MPC_LAND_SPEED).
_SINK_MPS = 2.0
_HORIZONTAL_MPS = 1.5
_TILT_RAD = math.radians(35.0)
_AIRBORNE_M = 0.3  # height of the lowest corner above which the vehicle is in the air


class _Pose(NamedTuple):
    stamp_s: float
    position: Vector  # (3,) ENU
    quaternion: Vector  # (4,) FLU -> ENU
    velocity: Vector  # (3,) ENU


@dataclass(frozen=True, slots=True, kw_only=True)
class Collision:
    """The first collision of a flight, with the ground or a box."""

    stamp_s: float  # time of contact, between two observations
    position_enu_m: tuple[float, float, float]  # vehicle at the time of contact
    speed_mps: float
    box_index: int | None  # None: the ground

    @property
    def what(self) -> str:
        """Name of the obstacle: `ground`, or `box` with the index of the box."""
        return "ground" if self.box_index is None else f"box {self.box_index}"

    @property
    def text(self) -> str:
        """One line for a status message, with the obstacle and the place of the collision."""
        place = " ".join(f"{c:.1f}" for c in self.position_enu_m)
        return f"Collision: {self.what} at {place}"


class Referee:
    """Judges one flight by the vehicle's true state, and logs that state.

    The referee detects the first collision, and measures the least clearance from the boxes and
    the flown distance.

    Args:
        body_box_m: Length, width and height of the vehicle's body box, centred on its position.
        vehicle, physics: Name of the vehicle, and its mass, thrust and power, for the report.
        pose: Where the poses come from, for the report, or None if they are the true ones.
        logs: Whether to keep a row of the log for every observation, for `log` and `save`.
    """

    def __init__(
        self,
        world: World,
        body_box_m: Sequence[float],
        *,
        vehicle: str = "",
        physics: Mapping[str, float] | None = None,
        pose: str | None = None,
        logs: bool = True,
    ) -> None:
        self.world = world
        self.vehicle = vehicle
        self.physics = dict(physics or {})
        self._pose = pose
        self._logs = logs
        self.collision: Collision | None = None
        self.distance_m = 0.0
        self.min_clearance_m = math.inf
        self._rows: list[tuple[float | Vector, ...]] = []
        self._half = np.array(body_box_m, dtype=np.float64) / 2.0
        self._boxes = np.array(world.boxes_enu_m)  # writable: one compiled signature
        self._airborne = False
        self._last: _Pose | None = None
        level = np.array([1.0, 0.0, 0.0, 0.0])
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
        """Check the motion since the last observation for a collision, and log the true state.

        Args:
            stamp_s: Simulated time.
            position_enu_m, velocity_enu_mps: (3,)
            quaternion_flu_enu: Unit quaternion (4,) w x y z, body forward-left-up to ENU.
            armed, on_ground: Whether the motors may turn, and whether the vehicle touches the
                ground according to the physics.
            may_land: Whether the flight controller is landing or taking off, so that a gentle
                ground contact is not a crash. A disarmed vehicle may always land.
            power_regression_w, power_propeller_w: Powers for the log.

        Returns the first collision of the flight in the call that detects it, otherwise None.
        Raises VehicleProcessError if position or attitude is not finite.
        """
        position = np.array(position_enu_m, dtype=np.float64)
        quaternion = np.array(quaternion_flu_enu, dtype=np.float64)
        velocity = np.array(velocity_enu_mps, dtype=np.float64)
        if not all(map(math.isfinite, (*position.tolist(), *quaternion.tolist()))):
            raise VehicleProcessError(
                f"at {stamp_s:.3f} s the simulated vehicle's position or attitude is not finite"
            )
        pose = _Pose(stamp_s, position, quaternion, velocity)
        before, self._last = self._last or pose, pose
        if armed:
            self.distance_m += math.dist(before.position.tolist(), position.tolist())
        may_land = may_land or not armed
        crashed = self._crashes(before.velocity, pose, on_ground=on_ground, may_land=may_land)
        collision = None if self.collision is not None else self._hit(before, pose, crashed=crashed)
        if self._logs:
            gap_m, _ = clearance(position, quaternion, self._half, self._boxes)
            observed = power_regression_w, power_propeller_w, armed, on_ground
            self._rows.append((stamp_s, position, velocity, quaternion, gap_m, *observed))
        return collision

    def _crashes(
        self, velocity_before: Vector, pose: _Pose, *, on_ground: bool, may_land: bool
    ) -> bool:
        """Return True if the newest pose is a crash into the ground.

        Contact before the first take-off is never a crash. A later contact is a crash unless the
        flight controller was landing, taking off or disarmed, and the contact is within the limits
        of a landing. The limits apply to the speed just before the contact.
        """
        w, x, y, z = pose.quaternion.tolist()
        up = (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y))
        parts = [abs(u) * half for u, half in zip(up, self._half.tolist(), strict=True)]
        reach = parts[0] + parts[1] + parts[2]  # `sum` rounds differently since Python 3.12
        lowest_m = float(pose.position[2]) - reach
        if lowest_m > _AIRBORNE_M and not on_ground:
            self._airborne = True
            return False
        if not self._airborne or not (on_ground or lowest_m <= 0.0):
            return False
        self._airborne = False
        is_gentle = (
            -velocity_before[2] <= _SINK_MPS
            and math.hypot(velocity_before[0], velocity_before[1]) <= _HORIZONTAL_MPS
            and math.acos(max(-1.0, min(1.0, up[2]))) <= _TILT_RAD
        )
        return not (may_land and is_gentle)

    def _hit(self, before: _Pose, now: _Pose, *, crashed: bool) -> Collision | None:
        share, box, self.min_clearance_m = sweep(
            before.position, before.quaternion, now.position, now.quaternion,
            self._half, self._boxes, self.min_clearance_m,
        )  # fmt: skip
        if box < 0 and not crashed:
            return None
        share = share if box >= 0 else 1.0
        place = before.position + share * (now.position - before.position)
        self.collision = Collision(
            stamp_s=before.stamp_s + share * (now.stamp_s - before.stamp_s),
            position_enu_m=(float(place[0]), float(place[1]), float(place[2])),
            speed_mps=norm(now.velocity),
            box_index=int(box) if box >= 0 else None,
        )
        return self.collision

    def report(self, energies_j: Mapping[str, float] | None = None) -> dict[str, Any]:
        """Return the result of the flight as a dict for JSON.

        The minimum clearance is None if the world has no boxes.
        """
        hit, least = self.collision, self.min_clearance_m
        return {
            "collision": None if hit is None else {**dataclasses.asdict(hit), "what": hit.what},
            "min_clearance_m": least if math.isfinite(least) else None,
            "distance_m": self.distance_m,
            "energies_j": dict(energies_j or {}),
            "vehicle": self.vehicle,
            "physics": self.physics,
            "world": self.world.as_dict(),
            **({} if self._pose is None else {"pose": self._pose}),
        }

    def log(self) -> dict[str, Vector]:
        """Return the columns of the log, keyed by name, with one row per observation."""
        columns = zip(*self._rows, strict=True) if self._rows else [[] for _ in _COLUMNS]
        return {name: np.array(column) for name, column in zip(_COLUMNS, columns, strict=True)}

    def save(self, folder: Path, energies_j: Mapping[str, float] | None = None) -> None:
        """Write `truth.npz` and then `truth.json` into `folder`, each atomically.

        Raises RecordError if a file cannot be written (no space, no permission).
        """
        with writing(folder):
            folder.mkdir(parents=True, exist_ok=True)
        columns: Any = self.log()
        write_atomically(folder / "truth.npz", lambda file: np.savez(file, **columns))
        write_json(folder / "truth.json", self.report(energies_j))
