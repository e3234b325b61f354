"""The conversion is exact both ways and agrees with the ellipsoid's radii of curvature."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sitl.vehicle.geodesy import (
    FLATTENING,
    SEMI_MAJOR_M,
    WORLD_ORIGIN,
    GeodeticPoint,
    geodetic_from_ned,
    ned_from_geodetic,
)

metres = st.floats(-5000.0, 5000.0)
E2 = FLATTENING * (2.0 - FLATTENING)


@settings(deadline=None)  # the first call may compile
@given(metres, metres, metres, st.floats(-80.0, 80.0), st.floats(-179.0, 179.0))
def test_there_and_back(north, east, down, latitude, longitude):
    origin = GeodeticPoint(latitude_deg=latitude, longitude_deg=longitude, altitude_m=100.0)
    position = np.array([north, east, down])
    back = ned_from_geodetic(geodetic_from_ned(position, origin), origin)
    np.testing.assert_allclose(back, position, rtol=0.0, atol=1e-7)


def test_origin_is_px4_home():
    point = geodetic_from_ned(np.zeros(3))
    assert point.latitude_deg == pytest.approx(47.397742, abs=1e-12)
    assert point.longitude_deg == pytest.approx(8.545594, abs=1e-12)
    assert point.altitude_m == pytest.approx(488.0, abs=1e-8)


def test_small_arcs_follow_the_radii_of_curvature():
    latitude = math.radians(WORLD_ORIGIN.latitude_deg)
    root = math.sqrt(1.0 - E2 * math.sin(latitude) ** 2)
    meridian = SEMI_MAJOR_M * (1.0 - E2) / root**3 + WORLD_ORIGIN.altitude_m
    normal = SEMI_MAJOR_M / root + WORLD_ORIGIN.altitude_m
    point = geodetic_from_ned(np.array([10.0, 10.0, 0.0]))
    north_m = math.radians(point.latitude_deg - WORLD_ORIGIN.latitude_deg) * meridian
    east_m = math.radians(point.longitude_deg - WORLD_ORIGIN.longitude_deg) * normal
    assert north_m == pytest.approx(10.0, abs=1e-4)
    assert east_m * math.cos(latitude) == pytest.approx(10.0, abs=1e-4)


def test_up_is_altitude():
    point = geodetic_from_ned(np.array([0.0, 0.0, -12.5]))
    assert point.altitude_m == pytest.approx(500.5, abs=1e-8)


def test_agrees_with_the_spherical_distance_of_other_software():
    # PX4 and ground stations measure on a sphere of 6371 km; they see our 100 m within 0.5 %.
    point = geodetic_from_ned(np.array([60.0, 80.0, 0.0]))
    a, b = math.radians(WORLD_ORIGIN.latitude_deg), math.radians(point.latitude_deg)
    delta = math.radians(point.longitude_deg - WORLD_ORIGIN.longitude_deg)
    haversine = math.sin((b - a) / 2) ** 2 + math.cos(a) * math.cos(b) * math.sin(delta / 2) ** 2
    assert 2 * 6371000.0 * math.asin(math.sqrt(haversine)) == pytest.approx(100.0, rel=5e-3)
