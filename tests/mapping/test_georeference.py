"""From the frame of a map to Earth: against pycolmap, and for cameras of known heading."""

import numpy as np
import pycolmap
import pytest

from slimsfm.mapping.georeference import Georeference, enu_of_wgs84, wgs84_of_enu

ORIGIN = np.array([55.7058, 13.1932, 50.0])
NORTH = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""`cam_from_enu` of a level camera that looks north: x east, y down, z north."""


def test_enu_is_that_of_pycolmap():
    places = ORIGIN + np.array([[0, 0, 0], [1e-3, -2e-3, 30], [-5e-3, 1e-3, -20]])
    expected = pycolmap.GPSTransform().ellipsoid_to_enu(places, *ORIGIN)
    np.testing.assert_allclose(enu_of_wgs84(places, ORIGIN), expected, atol=1e-6)


@pytest.mark.parametrize("origin", [ORIGIN, np.array([0.0, 179.9999, 0]), np.array([-89.9, 5.0, 2800])])
def test_enu_can_be_undone(origin):
    enu = np.random.default_rng(0).uniform(-500, 500, (20, 3))
    np.testing.assert_allclose(enu_of_wgs84(wgs84_of_enu(enu, origin), origin), enu, atol=1e-6)


@pytest.mark.parametrize(
    ("heading_deg", "expected"),
    [(0, [np.sqrt(0.5), 0, 0, -np.sqrt(0.5)]), (90, [0.5, -0.5, 0.5, -0.5]), (180, [0, -1, 1, 0])],
)
def test_a_level_camera_of_known_heading(heading_deg, expected):
    turn = pycolmap.Rotation3d(np.array([0, 0, np.radians(heading_deg)])).matrix()  # clockwise from above
    cam_from_enu = pycolmap.Rigid3d(pycolmap.Rotation3d(NORTH @ turn), np.zeros(3))
    place = Georeference(latitude=ORIGIN[0], longitude=ORIGIN[1], height=ORIGIN[2])
    found = place.geopose(cam_from_enu)
    quaternion = np.array(found.quaternion_xyzw)
    expected = np.array(expected) / np.linalg.norm(expected)
    assert abs(quaternion @ expected) == pytest.approx(1, abs=1e-9)
    forward = pycolmap.Rotation3d(quaternion) * np.array([0.0, 0, 1])
    heading = np.degrees(np.arctan2(forward[0], forward[1])) % 360
    assert (heading - heading_deg + 180) % 360 == pytest.approx(180, abs=1e-6)
    assert (found.latitude, found.longitude) == pytest.approx((ORIGIN[0], ORIGIN[1]), abs=1e-9)
    assert found.height == pytest.approx(ORIGIN[2], abs=1e-6)


def test_up_is_up_where_the_camera_is():
    place = Georeference(latitude=60.0, longitude=10.0, height=0.0)
    far = pycolmap.Rigid3d(pycolmap.Rotation3d(NORTH), -NORTH @ np.array([100_000.0, 0, 0]))
    found = place.geopose(far)
    down = pycolmap.Rotation3d(np.array(found.quaternion_xyzw)) * np.array([0.0, 1, 0])
    assert np.degrees(np.arccos(-down[2])) == pytest.approx(0.9, abs=0.02)  # 100 km are 0.9 degrees of Earth
    assert found.to_json()["position"] == {"lat": found.latitude, "lon": found.longitude, "h": found.height}


@pytest.mark.parametrize("latitude", [91.0, float("nan")])
def test_what_is_not_on_earth_is_refused(latitude):
    with pytest.raises(ValueError, match="on Earth"):
        Georeference(latitude=latitude, longitude=0.0, height=0.0)
