"""The referee: detects collisions and logs the true state of the vehicle."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mavfi_cli.core.errors import RecordError, VehicleProcessError
from mavfi_cli.core.files import write_atomically, write_json
from mavfi_cli.core.frames import Vector
from sitl.sweep import clearance, sweep
from sitl.world.world import World

# Columns of truth.npz, (n,) or (n, 3 or 4), one row per control tick.
_COLUMNS = (
    "stamp_s", "position_enu_m", "velocity_enu_mps",
    "quaternion",  # w x y z, body FLU -> ENU
    "clearance_m", "power_regression_w", "power_propeller_w", "armed", "on_ground",
)  # fmt: skip

# Limits of a landing. PX4 lands at 0.7 m/s (MPC_LAND_SPEED). They allow a hard landing on level
# legs, but neither a fall nor a touchdown at cruise speed.
_SINK_MPS = 2.0
_HORIZONTAL_MPS = 1.5
_TILT_RAD = math.radians(35.0)
_AIRBORNE_M = 0.3  # height of the lowest corner above which the vehicle is in the air


@dataclass(slots=True, kw_only=True)
class _GroundRule:
    """Classifies ground contacts from take-off to landing.

    A vehicle in contact before its first take-off stands on the ground. A later contact is a crash
    unless the flight controller was landing, taking off or disarmed, and the contact is within the
    limits of a landing. The limits apply to the speed just before the contact.
    """

    half_m: tuple[float, float, float]  # half sides of the body box
    _airborne: bool = False
    _velocity_before_mps: Vector | None = None  # (3,) ENU

    def crashed(
        self,
        position_enu_m: Vector,
        quaternion_flu_enu: Vector,
        velocity_enu_mps: Vector,
        *,
        on_ground: bool,
        may_land: bool,
    ) -> bool:
        """Return True if the newest pose is a crash. Call it once per observation."""
        lowest_m, tilt_rad = self._attitude(position_enu_m, quaternion_flu_enu)
        before = self._velocity_before_mps
        velocity = velocity_enu_mps if before is None else before
        self._velocity_before_mps = velocity_enu_mps.copy()
        if lowest_m > _AIRBORNE_M and not on_ground:
            self._airborne = True
            return False
        if not self._airborne or not (on_ground or lowest_m <= 0.0):
            return False
        self._airborne = False
        return not (may_land and _is_gentle(velocity, tilt_rad))

    def _attitude(self, position: Vector, quaternion: Vector) -> tuple[float, float]:
        """Return the height of the body's lowest corner, m, and the tilt of its up axis, rad."""
        w, x, y, z = quaternion.tolist()
        up = (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y))
        parts = [abs(u) * half for u, half in zip(up, self.half_m, strict=True)]
        reach = parts[0] + parts[1] + parts[2]  # `sum` rounds otherwise from Python 3.12 on
        return float(position[2]) - reach, math.acos(max(-1.0, min(1.0, up[2])))


def _is_gentle(velocity_mps: Vector, tilt_rad: float) -> bool:
    horizontal_mps = math.hypot(velocity_mps[0], velocity_mps[1])
    return (
        -velocity_mps[2] <= _SINK_MPS
        and horizontal_mps <= _HORIZONTAL_MPS
        and tilt_rad <= _TILT_RAD
    )


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
        """Short line for a status message."""
        place = " ".join(f"{c:.1f}" for c in self.position_enu_m)
        return f"Collision: {self.what} at {place}"


class Referee:
    """Collision, clearance, flown distance and truth log of one flight.

    Args:
        body_box_m: Length, width and height of the vehicle's body box, centred on its position.
        vehicle, physics: Name, mass and thrust of the vehicle, for the report.
        pose: Whose pose it judges, for the report; None for the true one.
        logs: Keep a row of truth for each observation, for `save`.
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
        length, width, height = body_box_m
        self._rows: list[tuple[float | Vector, ...]] = []
        self._half = np.array([length, width, height]) / 2.0
        self._boxes = np.array(world.boxes_enu_m)  # writable: one compiled signature
        self._ground = _GroundRule(half_m=(length / 2.0, width / 2.0, height / 2.0))
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
            stamp_s: Simulated time.
            position_enu_m, velocity_enu_mps: (3,)
            quaternion_flu_enu: Unit quaternion (4,) w x y z, body forward-left-up to ENU.
            armed: True if the motors may turn.
            on_ground: True if the physics reports ground contact.
            may_land: The flight controller is landing or taking off, so a gentle ground contact is
                not a crash. A disarmed vehicle may always land.
            power_regression_w, power_propeller_w: Powers for the log.

        Returns:
            First collision of the flight in the call that detects it, otherwise None.

        Raises:
            VehicleProcessError: The state is not finite.
        """
        position = np.array(position_enu_m, dtype=np.float64)
        quaternion = np.array(quaternion_flu_enu, dtype=np.float64)
        velocity = np.array(velocity_enu_mps, dtype=np.float64)
        if not math.isfinite(float(position.sum() + quaternion.sum())):
            raise VehicleProcessError(f"at {stamp_s:.3f} s the vehicle's state is not finite")
        may_land = may_land or not armed
        crashed = self._ground.crashed(
            position, quaternion, velocity, on_ground=on_ground, may_land=may_land
        )
        found = self._judge(stamp_s, position, quaternion, velocity, armed=armed, crashed=crashed)
        if self._logs:
            gap_m, _ = clearance(position, quaternion, self._half, self._boxes)
            powers = (power_regression_w, power_propeller_w)
            self._rows.append(
                (stamp_s, position, velocity, quaternion, gap_m, *powers, armed, on_ground)
            )
        return found

    def _judge(
        self,
        stamp_s: float,
        position: Vector,
        quaternion: Vector,
        velocity: Vector,
        *,
        armed: bool,
        crashed: bool,
    ) -> Collision | None:
        before, attitude_before, since = self._position, self._quaternion, self._stamp_s
        if before is None:
            before, attitude_before, since = position, quaternion, stamp_s
        self._position, self._quaternion, self._stamp_s = position, quaternion, stamp_s
        if armed:
            self.distance_m += math.dist(before, position)
        if self.collision is not None:
            return None
        poses = (before, attitude_before, position, quaternion)
        share, box, self.min_clearance_m = sweep(
            *poses, self._half, self._boxes, self.min_clearance_m
        )
        if box < 0 and not crashed:
            return None
        share = share if box >= 0 else 1.0
        place = before + share * (position - before)
        self.collision = Collision(
            stamp_s=since + share * (stamp_s - since),
            position_enu_m=(float(place[0]), float(place[1]), float(place[2])),
            speed_mps=float(np.linalg.norm(velocity)),
            box_index=int(box) if box >= 0 else None,
        )
        return self.collision

    def report(self, energies_j: Mapping[str, float] | None = None) -> dict[str, Any]:
        """Return the result of the flight for JSON. An infinite clearance (no boxes) is None."""
        hit, least = self.collision, self.min_clearance_m
        return {
            "collision": None
            if hit is None
            else {
                **dataclasses.asdict(hit),
                "position_enu_m": list(hit.position_enu_m),
                "what": hit.what,
            },
            "min_clearance_m": least if math.isfinite(least) else None,
            "distance_m": self.distance_m,
            "energies_j": dict(energies_j or {}),
            "vehicle": self.vehicle,
            "physics": self.physics,
            "world": self.world.as_json(),
            **({} if self._pose is None else {"pose": self._pose}),
        }

    def save(self, folder: Path, energies_j: Mapping[str, float] | None = None) -> None:
        """Write `truth.npz` and then `truth.json` into `folder`, each atomically.

        Raises:
            RecordError: The folder cannot be created or written (no space, no permission).
        """
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise RecordError(f"{folder}: cannot write the truth log: {error.strerror}") from None
        columns = zip(*self._rows, strict=True)
        arrays: dict[str, Any] = {
            name: np.array(column) for name, column in zip(_COLUMNS, columns, strict=True)
        }
        write_atomically(folder / "truth.npz", lambda file: np.savez(file, **arrays))
        write_json(folder / "truth.json", self.report(energies_j))
