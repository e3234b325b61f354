"""Parameters that fit real firmware to a vehicle profile.

The rate loops get the gains of our own flight controller, in the firmware's units: torque as a
share of what its mixer gives at full command. The firmware filters its gyroscope and its answer
is a step late, so the gains are reduced. All other gains stay the firmware's own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sitl.vehicle import cascade
from sitl.vehicle.gains import gains_for
from sitl.vehicle.profile import GRAVITY_MPS2, VehicleProfile

_REDUCED = 0.6
_PX4_TILT_SHARE = math.sqrt(0.5)  # share of each rotor's thrust at full roll or pitch
_PX4_YAW_SHARE = 1.0
_ARDUPILOT_SHARE = 0.5
_SPIN_MIN, _SPIN_ARM = 0.05, 0.03  # throttles of ArduPilot's rotors in flight and on the ground

Parameters = dict[str, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Loops:
    """Rate loops of our flight controller, N m of torque for each rad/s and so on (3,)."""

    p: np.ndarray[tuple[int], np.dtype[np.float64]]
    i: np.ndarray[tuple[int], np.dtype[np.float64]]
    d: np.ndarray[tuple[int], np.dtype[np.float64]]
    tilt_nm: float  # torque of all rotors at full differential thrust, round a level axis
    yaw_nm: float
    tilt_p: float  # 1/s
    hover_share: float  # thrust in hover / maximum thrust
    curve: float  # f in thrust share = f u^2 + (1 - f) u for a motor command u


def _loops(profile: VehicleProfile) -> _Loops:
    gains = gains_for(profile, 0.004)
    inertia = gains[cascade.G_INERTIA : cascade.G_INERTIA + 3]
    thrust_n = 4.0 * float(gains[cascade.G_ROTOR_THRUST])
    return _Loops(
        p=inertia * gains[cascade.G_RATE_P : cascade.G_RATE_P + 3] * _REDUCED,
        i=inertia * gains[cascade.G_RATE_I : cascade.G_RATE_I + 3] * _REDUCED,
        d=inertia * gains[cascade.G_RATE_D : cascade.G_RATE_D + 3] * _REDUCED,
        tilt_nm=thrust_n * float(gains[cascade.G_ROTOR_OFFSET]),
        yaw_nm=thrust_n * float(gains[cascade.G_TORQUE_PER_THRUST]),
        tilt_p=float(gains[cascade.G_TILT_P]) * _REDUCED,
        hover_share=profile.total_mass_kg * GRAVITY_MPS2 / thrust_n,
        curve=_curve(gains),
    )


def _curve(gains: np.ndarray[tuple[int], np.dtype[np.float64]]) -> float:
    """Fit f by least squares to the motors' throttle curve."""
    shares = np.linspace(0.05, 1.0, 40)
    commands = np.array([cascade.throttle(share, gains) for share in shares])
    bend = commands**2 - commands
    return float(bend @ (shares - commands) / (bend @ bend))


def px4_parameters(profile: VehicleProfile) -> Parameters:
    """Return PX4's parameters for a vehicle: rotors, thrust curve and rate loops."""
    loops = _loops(profile)
    tilt_nm, yaw_nm = loops.tilt_nm * _PX4_TILT_SHARE, loops.yaw_nm * _PX4_YAW_SHARE
    offset_m = profile.rotor.arm_m / math.sqrt(2.0)
    parameters: Parameters = {"CA_AIRFRAME": 0, "CA_ROTOR_COUNT": 4}
    layout = ((1, 1, 1), (-1, -1, 1), (1, -1, -1), (-1, 1, -1))  # forward, right, sense
    for rotor, (forward, right, sense) in enumerate(layout):
        parameters[f"CA_ROTOR{rotor}_PX"] = forward * offset_m
        parameters[f"CA_ROTOR{rotor}_PY"] = right * offset_m
        parameters[f"CA_ROTOR{rotor}_KM"] = sense * profile.rotor.torque_per_thrust_m
        parameters[f"PWM_MAIN_FUNC{rotor + 1}"] = 101 + rotor
    for number, (axis, full_nm) in enumerate(
        (("ROLL", tilt_nm), ("PITCH", tilt_nm), ("YAW", yaw_nm))
    ):
        parameters[f"MC_{axis}RATE_P"] = loops.p[number] / full_nm
        parameters[f"MC_{axis}RATE_I"] = loops.i[number] / full_nm
        parameters[f"MC_{axis}RATE_D"] = loops.d[number] / full_nm
    return parameters | {
        "MC_ROLL_P": loops.tilt_p,
        "MC_PITCH_P": loops.tilt_p,
        "THR_MDL_FAC": loops.curve,
        "MPC_THR_HOVER": loops.hover_share,
        "MPC_USE_HTE": 0,  # no estimate of the hover thrust: it is known
        "IMU_INTEG_RATE": 250,
        "EKF2_GPS_DELAY": 0,
        "SDLOG_BACKEND": 0,
    }


def ardupilot_parameters(profile: VehicleProfile) -> Parameters:
    """Return ArduCopter's parameters for a vehicle: frame, thrust curve and rate loops."""
    loops = _loops(profile)
    parameters: Parameters = {
        "FRAME_CLASS": 1,
        "FRAME_TYPE": 1,
        "MOT_THST_EXPO": loops.curve,
        "MOT_THST_HOVER": loops.hover_share,
        "MOT_HOVER_LEARN": 0,
        "MOT_SPIN_ARM": _SPIN_ARM,
        "MOT_SPIN_MIN": _SPIN_MIN,
        "MOT_SPIN_MAX": 1.0,
        "SIM_RATE_HZ": 400,
        "LOG_BACKEND_TYPE": 0,
        "FS_THR_ENABLE": 0,  # no radio control
        "ARMING_CHECK": 1,
    }
    full = (loops.tilt_nm, loops.tilt_nm, loops.yaw_nm)
    for number, axis in enumerate(("RLL", "PIT", "YAW")):
        full_nm = full[number] * _ARDUPILOT_SHARE
        parameters[f"ATC_RAT_{axis}_P"] = loops.p[number] / full_nm
        parameters[f"ATC_RAT_{axis}_I"] = loops.i[number] / full_nm
        parameters[f"ATC_RAT_{axis}_D"] = loops.d[number] / full_nm
    return parameters
