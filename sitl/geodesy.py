"""Converts between the local NED frame and geographic coordinates, and computes air pressure.

The conversion is an azimuthal equidistant projection on a sphere of 6,371,000 m (Snyder, Map
Projections: A Working Manual, 1987, equations 25-15 and 20-14), as in PX4.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

EARTH_RADIUS_M = 6_371_000.0

# International standard atmosphere up to 11 km
_SEA_LEVEL_PA, _LAPSE_PER_M, _EXPONENT = 101_325.0, 2.25577e-5, 5.25588


def standard_pressure_pa(altitude_m: float) -> float:
    """Return the standard air pressure, in Pa, at an altitude above sea level in metres.

    The pressure is 0 at altitudes above the modelled atmosphere, which ends at about 44 km.
    """
    return float(_SEA_LEVEL_PA * max(1.0 - _LAPSE_PER_M * altitude_m, 0.0) ** _EXPONENT)


def pressure_altitude_m(pressure_pa: float) -> float:
    """Return the altitude above sea level, in metres, where the standard pressure is `pressure_pa`.

    A negative pressure counts as 0 Pa.
    """
    share = max(pressure_pa, 0.0) / _SEA_LEVEL_PA
    return float((1.0 - share ** (1.0 / _EXPONENT)) / _LAPSE_PER_M)


def _sine_cosine(angle_deg: float) -> tuple[float, float]:
    return math.sin(math.radians(angle_deg)), math.cos(math.radians(angle_deg))


@dataclass(frozen=True, slots=True, kw_only=True)
class Origin:
    """Geographic origin of the local frame. The default is PX4 SITL's home near Zurich."""

    latitude_deg: float = 47.397742
    longitude_deg: float = 8.545594
    altitude_amsl_m: float = 489.4

    def geodetic(self, north_m: float, east_m: float) -> tuple[float, float]:
        """Return the latitude and longitude, in degrees, of a point in the local frame."""
        distance = math.hypot(north_m, east_m)
        if distance < 1e-9:
            return self.latitude_deg, self.longitude_deg
        origin_sine, origin_cosine = _sine_cosine(self.latitude_deg)
        arc = distance / EARTH_RADIUS_M
        sin_arc, cos_arc = math.sin(arc), math.cos(arc)
        sine = cos_arc * origin_sine + north_m * sin_arc * origin_cosine / distance
        latitude = math.asin(max(-1.0, min(1.0, sine)))
        longitude = math.radians(self.longitude_deg) + math.atan2(
            east_m * sin_arc, distance * origin_cosine * cos_arc - north_m * origin_sine * sin_arc
        )
        return math.degrees(latitude), math.degrees(longitude)

    def local(self, latitude_deg: float, longitude_deg: float) -> tuple[float, float]:
        """Return the local north and east, m, of a point given by its latitude and longitude."""
        delta = math.radians(longitude_deg - self.longitude_deg)
        sin_latitude, cos_latitude = _sine_cosine(latitude_deg)
        origin_sine, origin_cosine = _sine_cosine(self.latitude_deg)
        cosine = origin_sine * sin_latitude + origin_cosine * cos_latitude * math.cos(delta)
        arc = math.acos(max(-1.0, min(1.0, cosine)))
        scale = EARTH_RADIUS_M * (arc / math.sin(arc) if arc > 1e-9 else 1.0)
        north = origin_cosine * sin_latitude - origin_sine * cos_latitude * math.cos(delta)
        return scale * north, scale * cos_latitude * math.sin(delta)
