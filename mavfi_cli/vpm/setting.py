"""The model's inputs for one vehicle, and its performance with a protection scheme."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from mavfi_cli.core.errors import CannotLift
from mavfi_cli.vpm.board import Board
from mavfi_cli.vpm.model import (
    GRAVITY_MPS2,
    acceleration_mps2,
    hover_power_w,
    knee_hz,
    roof_mps,
    safe_velocity_mps,
)
from mavfi_cli.vpm.schemes import Scheme
from mavfi_cli.vpm.vehicle import ModelVehicle

_J_PER_WH = 3600.0


class Bound(Enum):
    """The limit that keeps the vehicle from flying faster."""

    BODY = "body dynamics"
    SENSOR = "sensor"
    COMPUTE = "compute"


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelInputs:
    """The model's inputs for one vehicle with its computer."""

    vehicle: ModelVehicle
    board: Board
    pull_n: float
    range_m: float
    compute_s: float  # response time of the computer without protection
    distance_m: float

    def carried_kg(self, copies: int) -> float:
        """Mass of the boards and their heat sinks, kg."""
        return copies * self.board.total_kg

    def mass_kg(self, copies: int) -> float:
        """Mass of everything that flies, kg."""
        return self.vehicle.mass_kg + self.carried_kg(copies)

    def acceleration_mps2(self, copies: int) -> float:
        """Largest acceleration, m/s^2; zero or less if the vehicle cannot lift its computer."""
        return acceleration_mps2(self.pull_n, self.mass_kg(copies), self.vehicle.tilt_rad)

    def response_s(self, overhead: float = 0.0) -> float:
        """Time from sensing to acting, s, CAL20 equation 1: the slower of sensor and computer."""
        return max(1.0 / self.vehicle.sensor_hz, self.compute_s * (1.0 + overhead))

    def velocity_mps(self, scheme: Scheme) -> float | None:
        """Safe velocity with a scheme, m/s; None if the vehicle cannot lift it."""
        accel = self.acceleration_mps2(scheme.copies)
        if accel <= 0.0:
            return None
        return safe_velocity_mps(accel, self.response_s(scheme.overhead), self.range_m)

    def too_heavy(self, copies: int) -> CannotLift:
        """The error that says why this many boards cannot be lifted."""
        return CannotLift(
            self.vehicle.name,
            pull_n=self.pull_n,
            mass_kg=self.vehicle.mass_kg,
            compute_kg=self.carried_kg(copies),
            limit_kg=self.mass_kg(copies) * (1.0 + self.acceleration_mps2(copies) / GRAVITY_MPS2),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class SchemePerformance:
    """Performance with a scheme, for hovering power and a straight path."""

    scheme: Scheme
    mass_kg: float
    compute_kg: float
    thrust_to_weight: float
    acceleration_mps2: float
    throughput_hz: float  # actions a second, the inverse of the response time
    compute_hz: float  # rate of the computer alone
    knee_hz: float
    roof_mps: float
    sensor_ceiling_mps: float
    compute_ceiling_mps: float
    bound: Bound
    velocity_mps: float
    flight_time_s: float
    power_w: float  # rotors and boards
    energy_j: float
    missions: float  # missions for each battery charge, not rounded


def outcome(setting: ModelInputs, scheme: Scheme) -> SchemePerformance:
    """Compute the performance of a vehicle with a scheme.

    Raises:
        CannotLift: the rotors do not lift this many boards.
    """
    vehicle, copies = setting.vehicle, scheme.copies
    accel, velocity = setting.acceleration_mps2(copies), setting.velocity_mps(scheme)
    if velocity is None:
        raise setting.too_heavy(copies)
    mass_kg, compute_s = setting.mass_kg(copies), setting.compute_s * (1.0 + scheme.overhead)
    knee, response_s = knee_hz(accel, setting.range_m), setting.response_s(scheme.overhead)
    rotors_w = hover_power_w(vehicle.hover_power_w, vehicle.mass_kg, mass_kg)
    power_w = rotors_w + copies * setting.board.power_w
    time_s = setting.distance_m / velocity
    slower = Bound.SENSOR if 1.0 / vehicle.sensor_hz > compute_s else Bound.COMPUTE
    return SchemePerformance(
        scheme=scheme,
        mass_kg=mass_kg,
        compute_kg=setting.carried_kg(copies),
        thrust_to_weight=setting.pull_n / (mass_kg * GRAVITY_MPS2),
        acceleration_mps2=accel,
        throughput_hz=1.0 / response_s,
        compute_hz=1.0 / compute_s,
        knee_hz=knee,
        roof_mps=roof_mps(accel, setting.range_m),
        sensor_ceiling_mps=safe_velocity_mps(accel, 1.0 / vehicle.sensor_hz, setting.range_m),
        compute_ceiling_mps=safe_velocity_mps(accel, compute_s, setting.range_m),
        bound=Bound.BODY if 1.0 / response_s >= knee else slower,
        velocity_mps=velocity,
        flight_time_s=time_s,
        power_w=power_w,
        energy_j=power_w * time_s,
        missions=vehicle.battery_wh * _J_PER_WH / (power_w * time_s),
    )
