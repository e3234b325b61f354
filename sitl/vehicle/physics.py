"""Writes JSBSim's files for a vehicle profile, and steps the physics under motor commands."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from string import Template

import jsbsim

from mavfi_cli.core.errors import RecordError, VehicleProcessError
from mavfi_cli.core.files import ScratchFolder
from mavfi_cli.core.frames import Vector
from sitl.vehicle.profile import GRAVITY_MPS2, VehicleProfile

# The ground falls below the tangent plane at its (latitude, longitude) origin by 0.05 mm at 100 m.
PLANET_RADIUS_M = 1.0e8
_MODEL = Path(__file__).parent / "model"  # JSBSim's files, with `$name` for a profile's values
AIRCRAFT = "quadrotor"
ROTORS = 4

INFLOW_SLOPE = 0.35  # slope of the thrust share at J = 0

_NEWTON_PER_POUND = 4.4482216152605
FOOT_M = 0.3048
FOOT_POUND_J = 1.3558179483314004


def write_model(profile: VehicleProfile, root: Path) -> None:
    """Write the JSBSim files for a profile to `root`: planet.xml, aircraft/ and engine/."""
    values = _values(profile)
    for template in _MODEL.rglob("*.xml"):
        path = root / template.relative_to(_MODEL)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(Template(template.read_text()).substitute(values))


def _values(profile: VehicleProfile) -> dict[str, float | str]:
    rotor, gear, drag = profile.rotor, profile.gear, profile.drag
    radius_ft, ratio = PLANET_RADIUS_M / FOOT_M, rotor.zero_thrust_advance_ratio
    damping = 2.0 * gear.damping_ratio * gear.natural_frequency_radps * profile.total_mass_kg / 4.0
    linear = zip("xyz", drag.linear_nspm, strict=True)
    quadratic = zip("xyz", drag.quadratic_ns2pm2, strict=True)
    inertia = zip("xyz", profile.inertia_kgm2, strict=True)
    return {
        "planet_radius_ft": radius_ft,
        "planet_gm_ft3ps2": GRAVITY_MPS2 / FOOT_M * radius_ft**2,
        "mass_kg": profile.total_mass_kg,
        **{f"i{axis}{axis}_kgm2": value for axis, value in inertia},
        "leg_m": gear.leg_radius_m / math.sqrt(2.0),
        "gear_height_m": gear.height_m,
        "gear_friction": gear.friction,
        "gear_stiffness_npm": profile.gear_stiffness_npm,
        "gear_damping_nspm": damping,
        "arm_m": rotor.arm_m / math.sqrt(2.0),
        "rotor_height_m": rotor.height_m,
        "full_throttle_v": rotor.full_throttle_voltage_v,
        "motor_kv_rpmpv": rotor.motor_kv_rpmpv,
        "motor_resistance_ohm": rotor.motor_resistance_ohm,
        "motor_no_load_a": rotor.motor_no_load_current_a,
        "rotor_inertia_kgm2": rotor.inertia_kgm2,
        "rotor_diameter_m": rotor.diameter_m,
        "thrust_table": _table(ratio, rotor.thrust_coefficient, thrust_share),
        "power_table": _table(ratio, rotor.power_coefficient, power_share),
        **{f"drag_linear_{a}": value * FOOT_M / _NEWTON_PER_POUND for a, value in linear},
        **{f"drag_quadratic_{a}": v * FOOT_M**2 / _NEWTON_PER_POUND for a, v in quadratic},
    }


def _table(ratio: float, static: float, share: Callable[[float], float]) -> str:
    """Return the rows of a JSBSim table for advance ratios from -1 to 1.5 times `ratio`.

    A row is an advance ratio and the coefficient there: `static` times `share` of the ratio.
    """
    advances = [step / 20.0 for step in range(-20, 31)]
    return "\n".join(f"{j * ratio:.6f} {static * share(j):.9f}" for j in advances)


def thrust_share(relative_advance: float) -> float:
    """Return a propeller's thrust coefficient as a share of its static thrust coefficient.

    `relative_advance` is the advance ratio divided by the one at which thrust vanishes. The share
    falls slowly at first and then faster, as is common for fixed-pitch propellers. The shape is an
    assumption; it agrees within 5 % with published data of 9-inch propellers.
    """
    if relative_advance < 0.0:
        return 1.0 - INFLOW_SLOPE * relative_advance
    return 1.0 - INFLOW_SLOPE * relative_advance - (1.0 - INFLOW_SLOPE) * relative_advance**2


def power_share(relative_advance: float) -> float:
    """Return a propeller's power coefficient as a share of its static power coefficient.

    `relative_advance` is as in `thrust_share`.
    """
    if relative_advance < 0.0:
        return 1.0 - 0.2 * relative_advance
    return max(1.0 - 0.2 * relative_advance - 0.7 * relative_advance**2, 0.02)


# Properties to read after a step, in order. Earth-centred axes at latitude and longitude zero are
# (up, east, north), so positions and velocities are those of the tangent plane itself.
RAW_PROPERTIES = (
    *(f"position/ecef-{axis}-ft" for axis in "zyx"),
    *(f"velocities/ecef-{axis}-fps" for axis in "zyx"),
    *(f"attitude/{angle}-rad" for angle in ("phi", "theta", "psi")),
    *(f"velocities/{axis}-rad_sec" for axis in "pqr"),
    "gear/wow",
    *(f"propulsion/engine[{n}]/propeller-rpm" for n in range(ROTORS)),
    *(f"propulsion/engine[{n}]/propeller-power-ftlbps" for n in range(ROTORS)),
)
RAW_POSITION, RAW_VELOCITY, RAW_EULER, RAW_RATES = 0, 3, 6, 9
RAW_WOW, RAW_RPM, RAW_POWER = 12, 13, 17
RAW_SIZE = len(RAW_PROPERTIES)


class Physics:
    """A JSBSim instance that simulates the vehicle of a profile above flat, fixed ground.

    Raises VehicleProcessError if JSBSim cannot load the vehicle.
    """

    def __init__(
        self, profile: VehicleProfile, *, position_ned_m: Vector, heading_rad: float, dt_s: float
    ) -> None:
        jsbsim.set_logger(jsbsim.DefaultLogger(jsbsim.LogLevel.FATAL))
        try:
            with ScratchFolder("vehicle") as folder:
                self._fdm = _load(profile, folder, dt_s)
        except (OSError, RecordError, jsbsim.BaseError) as error:
            problem = f"cannot make the model of vehicle {profile.name!r}: {error}"
            raise VehicleProcessError(problem) from None
        _place(self._fdm, position_ned_m, heading_rad)
        self._readers = [_node(self._fdm, name).get_double_value for name in RAW_PROPERTIES]
        self._writers = [
            _node(self._fdm, f"fcs/throttle-cmd-norm[{n}]").set_double_value for n in range(ROTORS)
        ]
        self._run = self._fdm.run

    def advance(self, commands: Vector) -> None:
        """Advance the physics by one step under motor commands (4,) in 0..1."""
        for write, command in zip(self._writers, commands.tolist(), strict=True):
            write(command)
        self._run()

    def read(self, raw: Vector) -> None:
        """Fill `raw` (RAW_SIZE,) with the values of RAW_PROPERTIES, in JSBSim's units.

        These are ft, ft/s, rad, rad/s, rpm and ft lbf/s.
        """
        raw[:] = [read() for read in self._readers]


def _node(fdm: jsbsim.FGFDMExec, name: str) -> jsbsim.FGPropertyNode:
    node = fdm.get_property_manager().get_node(name)
    if node is None:
        raise VehicleProcessError(f"the installed version of JSBSim lacks the property {name!r}")
    return node


def _load(profile: VehicleProfile, folder: Path, dt_s: float) -> jsbsim.FGFDMExec:
    write_model(profile, folder)
    fdm = jsbsim.FGFDMExec(str(folder))
    fdm.set_debug_level(0)
    fdm.disable_output()
    paths = (str(folder / "aircraft"), str(folder / "engine"), str(folder))
    has_planet = fdm.load_planet(str(folder / "planet.xml"), useAircraftPath=False)
    if not (has_planet and fdm.load_model_with_paths(AIRCRAFT, *paths)):
        raise VehicleProcessError(f"JSBSim cannot load the model of vehicle {profile.name!r}")
    fdm.set_dt(dt_s)
    return fdm


def _place(fdm: jsbsim.FGFDMExec, position_ned_m: Vector, heading_rad: float) -> None:
    """Set JSBSim's initial state: at rest, at a position (3,) and with a heading."""
    north, east, down = (float(value) for value in position_ned_m)
    up = PLANET_RADIUS_M - down
    fdm["ic/lat-geod-rad"] = math.atan2(north, math.hypot(up, east))
    fdm["ic/long-gc-rad"] = math.atan2(east, up)
    radius_m = math.sqrt(north * north + east * east + up * up)
    fdm["ic/h-sl-ft"] = (radius_m - PLANET_RADIUS_M) / FOOT_M
    fdm["ic/psi-true-rad"] = heading_rad % (2.0 * math.pi)
    if not fdm.run_ic():
        raise VehicleProcessError("JSBSim rejected the initial state of the vehicle")
