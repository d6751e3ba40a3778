"""Where on Earth a map is: from its frame to latitude, longitude and height, and back."""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pycolmap
from jaxtyping import Float64

from slimsfm.arrays import Points3D
from slimsfm.files import plain


@dataclass(frozen=True, kw_only=True)
class GeoPose:
    """Position and orientation of a camera on Earth, as in OGC GeoPose 1.0 (Basic-Quaternion).

    The standard's outer frame is the plane that touches the ellipsoid at the position, with axes east, north
    and up. The inner frame is the camera's, x right, y down, z forward: the quaternion turns vectors in the
    camera's frame into east, north, up. A level camera that looks north has (sin 45°, 0, 0, -cos 45°).
    """

    latitude: float
    """Degrees north, WGS84."""

    longitude: float
    """Degrees east, WGS84."""

    height: float
    """Meters above the ellipsoid, or above what the heights that the map was aligned by refer to."""

    quaternion_xyzw: tuple[float, float, float, float]
    """`enu_from_cam`, with a real part that is not negative."""

    def to_json(self) -> dict[str, dict[str, float]]:
        """The object that the standard's JSON schema describes."""
        return {
            "position": {"lat": self.latitude, "lon": self.longitude, "h": self.height},
            "quaternion": dict(zip("xyzw", self.quaternion_xyzw, strict=True)),
        }


@dataclass(frozen=True, kw_only=True, eq=False)
class Georeference:
    """A point on Earth, the frame of east, north and up there, and how the map's frame lies in it.

    `slimsfm.align` makes maps whose own frame is that of east, north and up, in meters.

    Raises:
        ValueError: The point is not on Earth.
    """

    latitude: float
    """Degrees north of the origin, WGS84."""

    longitude: float
    """Degrees east of the origin, WGS84."""

    height: float
    """Meters of the origin above the ellipsoid, or above what the given heights refer to."""

    enu_from_world: pycolmap.Sim3d = field(default_factory=pycolmap.Sim3d)
    """From the map's frame to meters east, north and up of the origin."""

    def __post_init__(self) -> None:
        if not abs(self.latitude) <= 90 or not abs(self.longitude) <= 180 or not np.isfinite(self.height):
            place = (self.latitude, self.longitude, self.height)
            raise ValueError(f"latitude, longitude and height must be on Earth, got {place}")

    def wgs84_of(self, points3D_in_world: Points3D) -> Float64[np.ndarray, "n 3"]:
        """Latitude and longitude in degrees and height in meters of points of the map."""
        enu = self.enu_from_world * points3D_in_world
        return wgs84_of_enu(enu, np.array([self.latitude, self.longitude, self.height]))

    def geopose(self, cam_from_world: pycolmap.Rigid3d) -> GeoPose:
        """Where on Earth a camera is, and how it is turned there."""
        cam_from_enu = self.enu_from_world.transform_camera_world(cam_from_world)
        center = cam_from_world.inverse().translation
        ((latitude, longitude, height),) = self.wgs84_of(center[None])
        there_from_ecef = enu_from_ecef(latitude, longitude)
        there_from_here = there_from_ecef @ enu_from_ecef(self.latitude, self.longitude).T
        turned = pycolmap.Rotation3d(there_from_here @ cam_from_enu.rotation.matrix().T)
        quaternion = turned.quat if turned.quat[3] >= 0 else -turned.quat
        return GeoPose(
            latitude=float(latitude),
            longitude=float(longitude),
            height=float(height),
            quaternion_xyzw=tuple(quaternion.tolist()),
        )

    def moved(self, new_from_old: pycolmap.Sim3d) -> "Georeference":
        """The georeference of the map in another frame: its points stay where they are on Earth."""
        return replace(self, enu_from_world=self.enu_from_world * new_from_old.inverse())

    def to_json(self) -> dict[str, Any]:
        """As in `map.json`."""
        return {
            "latitude": self.latitude,
            "longitude": self.longitude,
            "height": self.height,
            "enu_from_world": {
                "scale": float(self.enu_from_world.scale),
                "quaternion_xyzw": self.enu_from_world.rotation.quat.tolist(),
                "translation": self.enu_from_world.translation.tolist(),
            },
        }

    @classmethod
    def from_json(cls, data: dict[str, Any] | None) -> "Georeference | None":
        """As in `map.json`; None stays None."""
        if data is None:
            return None
        place = {name: plain(data[name], float) for name in ("latitude", "longitude", "height")}
        stored = data["enu_from_world"]
        x, y, z, w = plain(stored["quaternion_xyzw"], list[float])
        scale, shift = plain(stored["scale"], float), plain(stored["translation"], list[float])
        if scale <= 0 or not np.isclose(np.linalg.norm([x, y, z, w]), 1, atol=1e-6):
            raise ValueError("enu_from_world is not a similarity")
        rotation = pycolmap.Rotation3d(np.array([x, y, z, w]))
        return cls(**place, enu_from_world=pycolmap.Sim3d(scale, rotation, np.array(shift).reshape(3)))


def enu_from_ecef(latitude: float, longitude: float) -> Float64[np.ndarray, "3 3"]:
    """Rotation from the Earth's axes to east, north and up at a place, in degrees."""
    phi, lam = np.radians([latitude, longitude])
    return np.array(
        [
            [-np.sin(lam), np.cos(lam), 0],
            [-np.sin(phi) * np.cos(lam), -np.sin(phi) * np.sin(lam), np.cos(phi)],
            [np.cos(phi) * np.cos(lam), np.cos(phi) * np.sin(lam), np.sin(phi)],
        ]
    )


def enu_of_wgs84(
    wgs84: Float64[np.ndarray, "n 3"], origin: Float64[np.ndarray, "3"]
) -> Float64[np.ndarray, "n 3"]:
    """Meters east, north and up of an origin; places are latitude and longitude in degrees and height."""
    earth = pycolmap.GPSTransform()
    ecef = earth.ellipsoid_to_ecef(wgs84) - earth.ellipsoid_to_ecef(origin[None])
    return ecef @ enu_from_ecef(origin[0], origin[1]).T


def wgs84_of_enu(
    enu: Float64[np.ndarray, "n 3"], origin: Float64[np.ndarray, "3"]
) -> Float64[np.ndarray, "n 3"]:
    """Inverse of `enu_of_wgs84`."""
    earth = pycolmap.GPSTransform()
    ecef = earth.ellipsoid_to_ecef(origin[None]) + enu @ enu_from_ecef(origin[0], origin[1])
    return earth.ecef_to_ellipsoid(ecef)
