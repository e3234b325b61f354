"""Conversion between the local NED frame and latitude, longitude and altitude.

The conversion is an azimuthal equidistant projection on a sphere of 6,371,000 m (Snyder, Map
Projections: A Working Manual, 1987, equations 25-15 and 20-14), as in PX4.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

EARTH_RADIUS_M = 6_371_000.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Origin:
    """Geographic origin of the local frame. The default is PX4 SITL's home near Zurich."""

    latitude_deg: float = 47.397742
    longitude_deg: float = 8.545594
    altitude_amsl_m: float = 489.4
    _sin: float = field(init=False, repr=False)
    _cos: float = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_sin", math.sin(math.radians(self.latitude_deg)))
        object.__setattr__(self, "_cos", math.cos(math.radians(self.latitude_deg)))

    def geodetic(self, north_m: float, east_m: float) -> tuple[float, float]:
        """Return latitude and longitude, degrees, of a point of the local frame."""
        distance = math.hypot(north_m, east_m)
        if distance < 1e-9:
            return self.latitude_deg, self.longitude_deg
        arc = distance / EARTH_RADIUS_M
        sin_arc, cos_arc = math.sin(arc), math.cos(arc)
        sine = cos_arc * self._sin + north_m * sin_arc * self._cos / distance
        latitude = math.asin(max(-1.0, min(1.0, sine)))
        longitude = math.radians(self.longitude_deg) + math.atan2(
            east_m * sin_arc, distance * self._cos * cos_arc - north_m * self._sin * sin_arc
        )
        return math.degrees(latitude), math.degrees(longitude)

    def local(self, latitude_deg: float, longitude_deg: float) -> tuple[float, float]:
        """Return north and east, m, of a point given in degrees."""
        latitude = math.radians(latitude_deg)
        delta = math.radians(longitude_deg - self.longitude_deg)
        sin_latitude, cos_latitude = math.sin(latitude), math.cos(latitude)
        cosine = self._sin * sin_latitude + self._cos * cos_latitude * math.cos(delta)
        arc = math.acos(max(-1.0, min(1.0, cosine)))
        scale = EARTH_RADIUS_M * (arc / math.sin(arc) if arc > 1e-9 else 1.0)
        north = self._cos * sin_latitude - self._sin * cos_latitude * math.cos(delta)
        return scale * north, scale * cos_latitude * math.sin(delta)
