"""JSBSim: writes the files of a vehicle profile, takes motor commands, returns the raw state."""

from __future__ import annotations

import math
import tempfile
from pathlib import Path
from xml.etree import ElementTree as ET

import jsbsim

from mavfi_cli.core.errors import VehicleProcessError
from mavfi_cli.core.frames import Vector
from sitl.vehicle.profile import GRAVITY_MPS2, Rotor, VehicleProfile

# A planet that does not turn and is flat over a world. The ground falls below the tangent
# plane at its (latitude, longitude) origin by 0.05 mm at 100 m. Gravity is the standard one.
PLANET_RADIUS_M = 1.0e8
AIRCRAFT = "quadrotor"
ROTORS = 4

# Structural signs (forward, right) and sense (+1: turns counter-clockwise seen from above) of
# the rotors in PX4's order for an X frame: front right, rear left, front left, rear right.
ROTOR_LAYOUT = ((1.0, 1.0, 1.0), (-1.0, -1.0, 1.0), (1.0, -1.0, -1.0), (-1.0, 1.0, -1.0))

INFLOW_SLOPE = 0.35  # slope of the thrust share at J = 0

_NEWTON_PER_POUND = 4.4482216152605
FOOT_M = 0.3048
FOOT_POUND_J = 1.3558179483314004


def write_model(profile: VehicleProfile, root: Path) -> None:
    """Write the JSBSim files of a profile below `root`: planet.xml, aircraft/ and engine/."""
    aircraft = root / "aircraft" / AIRCRAFT
    engine = root / "engine"
    aircraft.mkdir(parents=True)
    engine.mkdir()
    _write(_planet(), root / "planet.xml")
    _write(_aircraft(profile), aircraft / f"{AIRCRAFT}.xml")
    _write(_motor(profile.rotor), engine / "motor.xml")
    _write(_propeller(profile.rotor), engine / "propeller.xml")


def _write(element: ET.Element, path: Path) -> None:
    ET.ElementTree(element).write(path, encoding="unicode")


def _value(parent: ET.Element, tag: str, value: float, unit: str = "") -> None:
    ET.SubElement(parent, tag, {"unit": unit} if unit else {}).text = f" {value!r} "


def _location(
    parent: ET.Element, forward_m: float, right_m: float, up_m: float, name: str = ""
) -> None:
    """Add a structural location: x aft, y right, z up."""
    place = ET.SubElement(parent, "location", {"unit": "M", **({"name": name} if name else {})})
    for tag, value in zip("xyz", (-forward_m, right_m, up_m), strict=True):
        _value(place, tag, value)


def _planet() -> ET.Element:
    planet = ET.Element("planet", {"name": "Flat"})
    # In feet, because JSBSim's own factor for metres is rounded to eight digits.
    radius_ft = PLANET_RADIUS_M / FOOT_M
    _value(planet, "semimajor_axis", radius_ft, "FT")
    _value(planet, "semiminor_axis", radius_ft, "FT")
    _value(planet, "rotation_rate", 0.0, "RAD/SEC")
    _value(planet, "GM", GRAVITY_MPS2 / FOOT_M * radius_ft**2, "FT3/SEC2")
    _value(planet, "J2", 0.0)
    return planet


def _aircraft(profile: VehicleProfile) -> ET.Element:
    root = ET.Element("fdm_config", {"name": AIRCRAFT, "version": "2.0", "release": "ALPHA"})
    ET.SubElement(root, "fileheader")
    _metrics(root)
    _mass(root, profile)
    _ground(root, profile)
    _propulsion(root, profile.rotor)
    ET.SubElement(root, "flight_control", {"name": "none"})
    _aerodynamics(root, profile)
    return root


def _metrics(root: ET.Element) -> None:
    metrics = ET.SubElement(root, "metrics")
    _value(metrics, "wingarea", 0.01, "M2")
    _value(metrics, "wingspan", 0.1, "M")
    _value(metrics, "chord", 0.1, "M")
    for name in ("AERORP", "EYEPOINT", "VRP"):
        _location(metrics, 0.0, 0.0, 0.0, name)


def _mass(root: ET.Element, profile: VehicleProfile) -> None:
    balance = ET.SubElement(root, "mass_balance")
    for tag, value in zip(("ixx", "iyy", "izz"), profile.inertia_kgm2, strict=True):
        _value(balance, tag, value, "KG*M2")
    _value(balance, "emptywt", profile.total_mass_kg, "KG")
    _location(balance, 0.0, 0.0, 0.0, "CG")


def _ground(root: ET.Element, profile: VehicleProfile) -> None:
    reactions = ET.SubElement(root, "ground_reactions")
    gear = profile.gear
    offset = gear.leg_radius_m / math.sqrt(2.0)
    damping = 2.0 * gear.damping_ratio * gear.natural_frequency_radps * profile.total_mass_kg / 4.0
    for number, (forward, right, _sense) in enumerate(ROTOR_LAYOUT):
        contact = ET.SubElement(reactions, "contact", {"type": "BOGEY", "name": f"leg{number}"})
        _location(contact, forward * offset, right * offset, -gear.height_m)
        _value(contact, "static_friction", gear.friction)
        _value(contact, "dynamic_friction", gear.friction)
        _value(contact, "rolling_friction", gear.friction)
        _value(contact, "spring_coeff", profile.gear_stiffness_npm, "N/M")
        _value(contact, "damping_coeff", damping, "N/M/SEC")


def _propulsion(root: ET.Element, rotor: Rotor) -> None:
    propulsion = ET.SubElement(root, "propulsion")
    offset = rotor.arm_m / math.sqrt(2.0)
    for number, (forward, right, sense) in enumerate(ROTOR_LAYOUT):
        engine = ET.SubElement(propulsion, "engine", {"file": "motor", "name": f"motor{number}"})
        thruster = ET.SubElement(engine, "thruster", {"file": "propeller"})
        _location(thruster, forward * offset, right * offset, rotor.height_m)
        orient = ET.SubElement(thruster, "orient", {"unit": "DEG"})
        for tag, angle in (("roll", 0.0), ("pitch", 90.0), ("yaw", 0.0)):
            _value(orient, tag, angle)
        _value(thruster, "sense", sense)
        _value(thruster, "p_factor", 0.0)


def _motor(rotor: Rotor) -> ET.Element:
    motor = ET.Element("brushless_dc_motor", {"name": "motor"})
    _value(motor, "maxvolts", rotor.full_throttle_voltage_v, "VOLTS")
    _value(motor, "velocityconstant", rotor.motor_kv_rpmpv)
    _value(motor, "coilresistance", rotor.motor_resistance_ohm, "OHMS")
    _value(motor, "noloadcurrent", rotor.motor_no_load_current_a, "AMPERES")
    return motor


def thrust_share(relative_advance: float) -> float:
    """Return C_T / static C_T at J / J(zero thrust), a shape common to fixed-pitch propellers.

    It falls slowly at first and then faster. This is an assumption, within 5 % of published 9-inch
    data.
    """
    if relative_advance < 0.0:
        return 1.0 - INFLOW_SLOPE * relative_advance
    return 1.0 - INFLOW_SLOPE * relative_advance - (1.0 - INFLOW_SLOPE) * relative_advance**2


def power_share(relative_advance: float) -> float:
    """Return C_P / static C_P at J / J(zero thrust); see `thrust_share`."""
    if relative_advance < 0.0:
        return 1.0 - 0.2 * relative_advance
    return max(1.0 - 0.2 * relative_advance - 0.7 * relative_advance**2, 0.02)


def _propeller(rotor: Rotor) -> ET.Element:
    propeller = ET.Element("propeller", {"name": "propeller", "version": "1.1"})
    _value(propeller, "ixx", rotor.inertia_kgm2, "KG*M2")
    _value(propeller, "diameter", rotor.diameter_m, "M")
    _value(propeller, "numblades", 2)
    _value(propeller, "constspeed", 0)
    for name, share, static in (
        ("C_THRUST", thrust_share, rotor.thrust_coefficient),
        ("C_POWER", power_share, rotor.power_coefficient),
    ):
        table = ET.SubElement(propeller, "table", {"name": name, "type": "internal"})
        rows = []
        for step in range(-20, 31):
            relative = step / 20.0
            advance = relative * rotor.zero_thrust_advance_ratio
            rows.append(f"{advance:.6f} {static * share(relative):.9f}")
        ET.SubElement(table, "tableData").text = "\n" + "\n".join(rows) + "\n"
    return propeller


def _aerodynamics(root: ET.Element, profile: VehicleProfile) -> None:
    aerodynamics = ET.SubElement(root, "aerodynamics")
    axes = zip("XYZ", "uvw", profile.drag.linear_nspm, profile.drag.quadratic_ns2pm2, strict=True)
    for axis, component, linear, quadratic in axes:
        holder = ET.SubElement(aerodynamics, "axis", {"name": axis})
        function = ET.SubElement(holder, "function", {"name": f"aero/drag-{component}"})
        product = ET.SubElement(function, "product")
        speed = f"velocities/{component}-aero-fps"
        _value(product, "value", -1.0)
        ET.SubElement(product, "property").text = speed
        total = ET.SubElement(product, "sum")
        _value(total, "value", linear * FOOT_M / _NEWTON_PER_POUND)
        growing = ET.SubElement(total, "product")
        _value(growing, "value", quadratic * FOOT_M**2 / _NEWTON_PER_POUND)
        magnitude = ET.SubElement(growing, "abs")
        ET.SubElement(magnitude, "property").text = speed


# Properties to read after a step, in order. Earth-centred axes at latitude and longitude zero are
# (up, east, north), so positions and velocities are those of the tangent plane itself.
RAW_PROPERTIES = (
    "position/ecef-z-ft",
    "position/ecef-y-ft",
    "position/ecef-x-ft",
    "velocities/ecef-z-fps",
    "velocities/ecef-y-fps",
    "velocities/ecef-x-fps",
    "attitude/phi-rad",
    "attitude/theta-rad",
    "attitude/psi-rad",
    "velocities/p-rad_sec",
    "velocities/q-rad_sec",
    "velocities/r-rad_sec",
    "gear/wow",
    *(f"propulsion/engine[{n}]/propeller-rpm" for n in range(ROTORS)),
    *(f"propulsion/engine[{n}]/propeller-power-ftlbps" for n in range(ROTORS)),
)
RAW_POSITION = 0
RAW_VELOCITY = 3
RAW_EULER = 6
RAW_RATES = 9
RAW_WOW = 12
RAW_RPM = 13
RAW_POWER = 17
RAW_SIZE = len(RAW_PROPERTIES)


class Physics:
    """A JSBSim instance that flies a profile over flat, fixed ground."""

    def __init__(
        self,
        profile: VehicleProfile,
        *,
        position_ned_m: Vector,
        heading_rad: float,
        dt_s: float,
    ) -> None:
        jsbsim.set_logger(jsbsim.DefaultLogger(jsbsim.LogLevel.FATAL))
        try:
            with tempfile.TemporaryDirectory(prefix="mavfi-vehicle-") as folder:
                self._fdm = _load(profile, Path(folder), dt_s)
        except (OSError, jsbsim.BaseError) as error:
            problem = f"cannot make the model of vehicle {profile.name!r}: {error}"
            raise VehicleProcessError(problem) from None
        _place(self._fdm, position_ned_m, heading_rad)
        self._readers = [_node(self._fdm, name).get_double_value for name in RAW_PROPERTIES]
        self._writers = [
            _node(self._fdm, f"fcs/throttle-cmd-norm[{n}]").set_double_value for n in range(ROTORS)
        ]
        self._run = self._fdm.run

    def advance(self, commands: Vector) -> None:
        """Advance one step with motor commands (4,) in 0..1."""
        for write, command in zip(self._writers, commands.tolist(), strict=True):
            write(command)
        self._run()

    def read(self, raw: Vector) -> None:
        """Fill `raw` (RAW_SIZE,) in JSBSim's units: ft, ft/s, rad, rad/s, rpm, ft lbf/s."""
        raw[:] = [read() for read in self._readers]


def _node(fdm: jsbsim.FGFDMExec, name: str) -> jsbsim.FGPropertyNode:
    node = fdm.get_property_manager().get_node(name)
    if node is None:
        raise VehicleProcessError(f"this JSBSim has no property {name!r}")
    return node


def _load(profile: VehicleProfile, folder: Path, dt_s: float) -> jsbsim.FGFDMExec:
    write_model(profile, folder)
    fdm = jsbsim.FGFDMExec(str(folder))
    fdm.set_debug_level(0)
    fdm.disable_output()
    loaded = fdm.load_planet(
        str(folder / "planet.xml"), useAircraftPath=False
    ) and fdm.load_model_with_paths(
        AIRCRAFT, str(folder / "aircraft"), str(folder / "engine"), str(folder)
    )
    if not loaded:
        raise VehicleProcessError(f"JSBSim cannot load the model of vehicle {profile.name!r}")
    fdm.set_dt(dt_s)
    return fdm


def _place(fdm: jsbsim.FGFDMExec, position_ned_m: Vector, heading_rad: float) -> None:
    """Set the initial state: at rest at a position (3,) and heading."""
    north, east, down = (float(value) for value in position_ned_m)
    up = PLANET_RADIUS_M - down
    fdm["ic/lat-geod-rad"] = math.atan2(north, math.hypot(up, east))
    fdm["ic/long-gc-rad"] = math.atan2(east, up)
    radius_m = math.sqrt(north * north + east * east + up * up)
    fdm["ic/h-sl-ft"] = (radius_m - PLANET_RADIUS_M) / FOOT_M
    fdm["ic/psi-true-rad"] = heading_rad % (2.0 * math.pi)
    if not fdm.run_ic():
        raise VehicleProcessError("JSBSim refuses the initial state")
