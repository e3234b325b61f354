import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sitl.geodesy import EARTH_RADIUS_M, Origin, pressure_altitude_m, standard_pressure_pa

metres = st.floats(-20_000.0, 20_000.0)


def haversine_m(latitude1, longitude1, latitude2, longitude2):
    a, b = math.radians(latitude1), math.radians(latitude2)
    half = math.sin((b - a) / 2) ** 2
    half += math.cos(a) * math.cos(b) * math.sin(math.radians(longitude2 - longitude1) / 2) ** 2
    return 2 * EARTH_RADIUS_M * math.asin(math.sqrt(half))


@given(metres, metres)
def test_there_and_back(north, east):
    origin = Origin()
    back = origin.local(*origin.geodetic(north, east))
    assert back == pytest.approx((north, east), abs=2e-3)


@given(metres, metres)
def test_distance_from_the_origin_is_kept(north, east):
    origin = Origin()
    latitude, longitude = origin.geodetic(north, east)
    flown = haversine_m(origin.latitude_deg, origin.longitude_deg, latitude, longitude)
    assert flown == pytest.approx(math.hypot(north, east), abs=1e-3)


def test_north_is_latitude_and_east_is_longitude():
    origin = Origin()
    latitude, longitude = origin.geodetic(1000.0, 0.0)
    degree_m = math.radians(1.0) * EARTH_RADIUS_M
    assert latitude - origin.latitude_deg == pytest.approx(1000.0 / degree_m, rel=1e-9)
    assert longitude == pytest.approx(origin.longitude_deg, abs=1e-12)
    assert origin.geodetic(0.0, 10.0)[1] > origin.longitude_deg


@pytest.mark.parametrize(
    ("altitude_m", "pressure_pa"), [(0.0, 101_325.0), (1000.0, 89_875.0), (11_000.0, 22_632.0)]
)
def test_pressure_is_that_of_the_standard_atmosphere(altitude_m, pressure_pa):
    """Values of the ICAO standard atmosphere (Doc 7488)."""
    assert standard_pressure_pa(altitude_m) == pytest.approx(pressure_pa, rel=1e-4)
    assert pressure_altitude_m(pressure_pa) == pytest.approx(altitude_m, abs=1.0)


def test_no_height_and_no_noise_of_a_barometer_leaves_the_numbers():
    assert standard_pressure_pa(1e6) == 0.0
    assert math.isfinite(pressure_altitude_m(-1.0))
