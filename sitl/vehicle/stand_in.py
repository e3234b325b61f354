"""A shipped quadrotor scaled to stand in for another one, defined by a profile with a `base`.

Mass, rotor pull, hover power and battery become those of the other vehicle. Size, propellers and
drag stay those of the base.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

from sitl.vehicle.profile import (
    GRAVITY_MPS2,
    LARGEST_TILT_DEG,
    LEVEL_SHARE,
    Rotor,
    VehicleProfile,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class StandIn:
    """A profile that scales another. None keeps the value of the base."""

    name: str
    base: str  # name of a shipped profile
    description: str = ""
    mass_kg: float | None = None  # ready to fly, without payload
    extra_payload_kg: float = 0.0
    rotor_pull_n: float | None = None  # static thrust of all rotors at full throttle
    acceleration_mps2: float | None = None  # horizontal acceleration that the tilt limit must allow
    hover_power_w: float | None = None  # electrical power of the rotors in hover at mass_kg
    battery_wh: float | None = None
    avionics_w: float | None = None  # power of everything except the rotors

    def __post_init__(self) -> None:
        for key in ("mass_kg", "rotor_pull_n", "hover_power_w", "battery_wh", "acceleration_mps2"):
            value = getattr(self, key)
            if value is not None and value <= 0.0:
                raise ValueError(f"{key}: must be above zero, is {value:g}")

    def profile(self, base: VehicleProfile) -> VehicleProfile:
        """Return the scaled quadrotor.

        - Inertia grows with mass_kg, because the shape stays the same. Payload adds none, because
          it is at the centre of mass.
        - The rotors turn faster for more pull. Thrust ~ n^2, so n grows with the square root of the
          ratio. The motors' Kv grows with n, so that the voltage at full throttle stays within the
          battery's.
        - The drive's efficiency is set so that the base's propellers take hover_power_w.
        - The tilt limit is raised if acceleration_mps2 needs it, to LARGEST_TILT_DEG at most.

        Raises:
            ConfigError: The profile cannot fly. Gives the numbers.
            ValueError: The propellers take more shaft power than hover_power_w.
        """
        mass_kg = self.mass_kg or base.mass_kg
        rotor = _with_pull(base, self.rotor_pull_n or base.max_thrust_n)
        battery = base.battery
        if self.battery_wh is not None:
            nominal_v = battery.cells * battery.cell_nominal_v
            battery = dataclasses.replace(battery, capacity_ah=self.battery_wh / nominal_v)
        if self.avionics_w is not None:
            battery = dataclasses.replace(battery, avionics_w=self.avionics_w)
        if self.hover_power_w is not None:
            share = rotor.hover_power_w(mass_kg) / self.hover_power_w
            if share > 1.0:
                raise ValueError(
                    f"hover_power_w: {self.hover_power_w:g} W do not hover {mass_kg:g} kg: the "
                    f"propellers of {self.base!r} take {rotor.hover_power_w(mass_kg):.1f} W"
                )
            battery = dataclasses.replace(battery, drive_efficiency=share)
        grown = mass_kg / base.mass_kg
        ixx, iyy, izz = base.inertia_kgm2
        return dataclasses.replace(
            base,
            name=self.name,
            description=self.description,
            mass_kg=mass_kg,
            extra_payload_kg=self.extra_payload_kg,
            inertia_kgm2=(grown * ixx, grown * iyy, grown * izz),
            rotor=rotor,
            battery=battery,
            limits=dataclasses.replace(base.limits, tilt_deg=self._tilt_deg(base)),
        )

    def _tilt_deg(self, base: VehicleProfile) -> float:
        if self.acceleration_mps2 is None:
            return base.limits.tilt_deg
        tangent = self.acceleration_mps2 / (LEVEL_SHARE * GRAVITY_MPS2)
        needed_deg = math.degrees(math.atan(tangent))
        return min(max(needed_deg, base.limits.tilt_deg), LARGEST_TILT_DEG)


def _with_pull(base: VehicleProfile, pull_n: float) -> Rotor:
    faster = math.sqrt(pull_n / base.max_thrust_n)
    return dataclasses.replace(
        base.rotor,
        max_rpm=faster * base.rotor.max_rpm,
        motor_kv_rpmpv=faster * base.rotor.motor_kv_rpmpv,
    )
