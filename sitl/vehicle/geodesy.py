"""Between the local NED tangent plane and WGS 84 latitude, longitude and altitude.

Equations: geodetic to Earth-centred coordinates in closed form, and Bowring's iteration back
(B. R. Bowring, "Transformation from spatial to geographical coordinates", Survey Review 23,
1976). Altitude above the ellipsoid stands for altitude above mean sea level.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]

SEMI_MAJOR_M = 6378137.0
FLATTENING = 1.0 / 298.257223563
_SEMI_MINOR_M = SEMI_MAJOR_M * (1.0 - FLATTENING)
_ECCENTRICITY2 = FLATTENING * (2.0 - FLATTENING)
_SECOND_ECCENTRICITY2 = _ECCENTRICITY2 / (1.0 - _ECCENTRICITY2)
_BOWRING_PASSES = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class GeodeticPoint:
    """A place on or above the Earth."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float


# Where the world's origin lies: the home of PX4's simulations, at Zurich.
WORLD_ORIGIN = GeodeticPoint(latitude_deg=47.397742, longitude_deg=8.545594, altitude_m=488.0)


def geodetic_from_ned(
    position_ned_m: Vector, origin: GeodeticPoint = WORLD_ORIGIN
) -> GeodeticPoint:
    """The geodetic point of a position (3,) in the tangent plane at `origin`, m."""
    offset = _axes(origin).T @ np.asarray(position_ned_m, dtype=np.float64)
    return _geodetic(_earth_centred(origin) + offset)


def ned_from_geodetic(point: GeodeticPoint, origin: GeodeticPoint = WORLD_ORIGIN) -> Vector:
    """The position (3,) of a geodetic point in the tangent plane at `origin`, NED, m."""
    offset = _earth_centred(point) - _earth_centred(origin)
    position: Vector = _axes(origin) @ offset
    return position


def _axes(point: GeodeticPoint) -> NDArray[np.float64]:
    """Rows north, east and down (3, 3) of a point in Earth-centred coordinates."""
    latitude = math.radians(point.latitude_deg)
    longitude = math.radians(point.longitude_deg)
    sin_lat, cos_lat = math.sin(latitude), math.cos(latitude)
    sin_lon, cos_lon = math.sin(longitude), math.cos(longitude)
    return np.array(
        [
            [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
            [-sin_lon, cos_lon, 0.0],
            [-cos_lat * cos_lon, -cos_lat * sin_lon, -sin_lat],
        ]
    )


def _earth_centred(point: GeodeticPoint) -> Vector:
    latitude = math.radians(point.latitude_deg)
    longitude = math.radians(point.longitude_deg)
    sin_lat, cos_lat = math.sin(latitude), math.cos(latitude)
    normal_m = SEMI_MAJOR_M / math.sqrt(1.0 - _ECCENTRICITY2 * sin_lat**2)
    across_m = (normal_m + point.altitude_m) * cos_lat
    return np.array(
        [
            across_m * math.cos(longitude),
            across_m * math.sin(longitude),
            (normal_m * (1.0 - _ECCENTRICITY2) + point.altitude_m) * sin_lat,
        ]
    )


def _geodetic(position_m: Vector) -> GeodeticPoint:
    x, y, z = (float(value) for value in position_m)
    across = math.hypot(x, y)
    reduced = math.atan2(z * SEMI_MAJOR_M, across * _SEMI_MINOR_M)
    latitude = 0.0
    for _ in range(_BOWRING_PASSES):
        latitude = math.atan2(
            z + _SECOND_ECCENTRICITY2 * _SEMI_MINOR_M * math.sin(reduced) ** 3,
            across - _ECCENTRICITY2 * SEMI_MAJOR_M * math.cos(reduced) ** 3,
        )
        reduced = math.atan2((1.0 - FLATTENING) * math.sin(latitude), math.cos(latitude))
    sin_lat, cos_lat = math.sin(latitude), math.cos(latitude)
    surface = SEMI_MAJOR_M * math.sqrt(1.0 - _ECCENTRICITY2 * sin_lat**2)
    return GeodeticPoint(
        latitude_deg=math.degrees(latitude),
        longitude_deg=math.degrees(math.atan2(y, x)),
        altitude_m=across * cos_lat + z * sin_lat - surface,
    )
