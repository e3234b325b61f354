"""Converts SET_POSITION_TARGET messages to the vehicle's setpoint by PX4's rules.

The setpoint is an array (11,): position, velocity, acceleration (NED; m, m/s, m/s^2), yaw (rad)
and yaw rate (rad/s). NaN means not controlled.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from mavfi_cli.core.frames import Vector
from sitl.geodesy import Origin

Setpoint = Vector

_LOCAL_NED = 1
_BODY_NED = 8
_ABSOLUTE_ALTITUDE = (0, 5)
_ABOVE_HOME = (3, 6, 10, 11)  # includes above terrain, because the ground is flat

_IGNORE_POSITION = 0x0007
_IGNORE_VELOCITY = 0x0038
_IGNORE_ACCELERATION = 0x01C0
_FORCE = 0x0200
_IGNORE_YAW = 0x0400
_IGNORE_YAW_RATE = 0x0800

_FARTHEST_M = 1e6  # a larger value counts as not controlled
_STEEPEST_MPS2 = 100.0


class SetpointRefused(Exception):
    """A setpoint that the autopilot rejects. The message is the STATUSTEXT."""


def no_setpoint() -> Setpoint:
    """Return a setpoint that controls nothing."""
    return np.full(11, math.nan)


def local_setpoint(message: Any, heading_rad: float) -> Setpoint:
    """Return the setpoint of a SET_POSITION_TARGET_LOCAL_NED.

    Args:
        message: Message with frame LOCAL_NED, or BODY_NED, which is rotated by the heading.
        heading_rad: Present heading of the vehicle from north.

    Raises:
        SetpointRefused: the frame or the type mask is not supported.
    """
    name = "SET_POSITION_TARGET_LOCAL_NED"
    frame, mask = message.coordinate_frame, message.type_mask
    if frame not in (_LOCAL_NED, _BODY_NED):
        raise SetpointRefused(f"{name} coordinate frame {frame} unsupported")
    if frame == _BODY_NED:
        mask |= _IGNORE_POSITION  # PX4 accepts positions in the local frame only
    _check_mask(name, mask)
    out = no_setpoint()
    _fill_motion(out, message, mask)
    if mask & _IGNORE_POSITION != _IGNORE_POSITION:
        _fill(out, 0, (message.x, message.y, message.z), mask, _FARTHEST_M)
    if frame == _BODY_NED:
        _turn(out, heading_rad)
    return out


def global_setpoint(message: Any, origin: Origin, home_down_m: float) -> Setpoint:
    """Return the setpoint of a SET_POSITION_TARGET_GLOBAL_INT, with altitude above sea or home.

    Raises:
        SetpointRefused: the frame or the type mask is not supported.
    """
    name = "SET_POSITION_TARGET_GLOBAL_INT"
    frame, mask = message.coordinate_frame, message.type_mask
    if frame not in _ABSOLUTE_ALTITUDE + _ABOVE_HOME:
        raise SetpointRefused(f"{name} coordinate frame {frame} unsupported")
    _check_mask(name, mask)
    out = no_setpoint()
    _fill_motion(out, message, mask)
    if mask & _IGNORE_POSITION != _IGNORE_POSITION:
        north, east = origin.local(message.lat_int * 1e-7, message.lon_int * 1e-7)
        above_home = frame in _ABOVE_HOME
        down = home_down_m - message.alt if above_home else origin.altitude_amsl_m - message.alt
        _fill(out, 0, (north, east, down), mask, _FARTHEST_M)
    return out


def _check_mask(name: str, mask: int) -> None:
    position = mask & _IGNORE_POSITION != _IGNORE_POSITION
    velocity = mask & _IGNORE_VELOCITY != _IGNORE_VELOCITY
    acceleration = mask & _IGNORE_ACCELERATION != _IGNORE_ACCELERATION
    if acceleration and mask & _FORCE:  # the bit gives the acceleration fields' meaning
        raise SetpointRefused(f"{name} force not supported")
    if acceleration and not position and not velocity:
        raise SetpointRefused(f"{name} acceleration without velocity not supported")
    if not position and not velocity:
        raise SetpointRefused(f"{name} invalid")


def _fill_motion(out: Setpoint, message: Any, mask: int) -> None:
    _fill(out, 3, (message.vx, message.vy, message.vz), mask >> 3, _FARTHEST_M)
    _fill(out, 6, (message.afx, message.afy, message.afz), mask >> 6, _STEEPEST_MPS2)
    if not mask & _IGNORE_YAW and math.isfinite(message.yaw):
        out[9] = math.remainder(message.yaw, math.tau)
    if not mask & _IGNORE_YAW_RATE and abs(message.yaw_rate) < _STEEPEST_MPS2:
        out[10] = message.yaw_rate


def _fill(
    out: Setpoint, start: int, values: tuple[float, float, float], ignored: int, limit: float
) -> None:
    """Write the components that the mask does not ignore, except NaN and huge values."""
    for axis, value in enumerate(values):
        if not ignored >> axis & 1 and abs(value) <= limit:
            out[start + axis] = value


def _turn(out: Setpoint, heading_rad: float) -> None:
    """Rotate velocity and acceleration from forward-right to north-east."""
    cosine, sine = math.cos(heading_rad), math.sin(heading_rad)
    for start in (3, 6):
        forward, right = out[start], out[start + 1]
        if math.isnan(forward) and math.isnan(right):
            continue
        forward, right = np.nan_to_num(forward), np.nan_to_num(right)
        out[start] = cosine * forward - sine * right
        out[start + 1] = sine * forward + cosine * right
