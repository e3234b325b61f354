"""Wrapper of JSBSim: takes motor commands, returns the raw state, prints and writes nothing."""

from __future__ import annotations

import math
import tempfile
from pathlib import Path

import jsbsim
import numpy as np
from numpy.typing import NDArray

from mavfi_cli.core.errors import VehicleProcessError
from sitl.vehicle.model import AIRCRAFT, PLANET_RADIUS_M, ROTORS, write_model
from sitl.vehicle.profile import VehicleProfile

FOOT_M = 0.3048
FOOT_POUND_J = 1.3558179483314004

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
        position_ned_m: NDArray[np.float64],
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

    def advance(self, commands: NDArray[np.float64]) -> None:
        """Advance one step with motor commands (4,) in 0..1."""
        for write, command in zip(self._writers, commands.tolist(), strict=True):
            write(command)
        self._run()

    def read(self, raw: NDArray[np.float64]) -> None:
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


def _place(fdm: jsbsim.FGFDMExec, position_ned_m: NDArray[np.float64], heading_rad: float) -> None:
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
