"""Coordinates of users, and the plane in meters in which plans are made."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, Literal

import numpy as np

from sb3_uav.common.optional import require

#: ``"wgs84"``: latitude and longitude in degrees; ``"plane"``: x and y of a plane.
System = Literal["wgs84", "plane"]


class Coordinates(ABC):
    """
    A system of coordinates with a plane in meters.

    :ivar system: Name of the system
    :ivar names: Names of its two coordinates, in the order of all arrays
    """

    system: System
    names: tuple[str, str]

    @abstractmethod
    def to_plane(self, points: np.ndarray) -> np.ndarray:
        """
        :param points: ``(n, 2)`` in the user's coordinates
        :return: ``(n, 2)`` in meters
        """

    @abstractmethod
    def from_plane(self, points: np.ndarray) -> np.ndarray:
        """
        :param points: ``(n, 2)`` in meters
        :return: ``(n, 2)`` in the user's coordinates
        """

    @abstractmethod
    def leg_lengths(self, points: np.ndarray) -> np.ndarray:
        """
        :param points: ``(n, 2)`` in the user's coordinates, in flying order
        :return: ``(n - 1,)``, the length of every leg in meters, geodesic where that is not the length in the plane
        """


class Plane(Coordinates):
    """
    A plane of the user's own.

    :param meters_per_unit: Length of one unit
    """

    system: System = "plane"
    names = ("x", "y")

    def __init__(self, meters_per_unit: float = 1.0) -> None:
        self.meters_per_unit = meters_per_unit

    def to_plane(self, points: np.ndarray) -> np.ndarray:
        return np.asarray(points, float) * self.meters_per_unit

    def from_plane(self, points: np.ndarray) -> np.ndarray:
        return np.asarray(points, float) / self.meters_per_unit

    def leg_lengths(self, points: np.ndarray) -> np.ndarray:
        lengths: np.ndarray = np.hypot(*np.diff(self.to_plane(points), axis=0).T)
        return lengths


class Geographic(Coordinates):
    """
    Latitude and longitude on WGS84, in an azimuthal equidistant plane around a point.

    Lengths in that plane are never shorter than geodesics: along the radius they are equal, and across it the plane stretches.
    So a route that is within its range in the plane is within its range on the ground. See
    https://proj.org/en/stable/operations/projections/aeqd.html.

    :param center: Latitude and longitude of the center, in degrees
    :raises ImportError: If pyproj is not installed
    """

    system: System = "wgs84"
    names = ("lat", "lon")

    def __init__(self, center: Any) -> None:
        pyproj = require("pyproj", "Latitudes and longitudes", "geo")
        latitude, longitude = (float(x) for x in center)
        self._geod = pyproj.Geod(ellps="WGS84")
        self._project = pyproj.Proj(proj="aeqd", lat_0=latitude, lon_0=longitude, ellps="WGS84")

    def to_plane(self, points: np.ndarray) -> np.ndarray:
        latitude, longitude = np.asarray(points, float).reshape(-1, 2).T
        return np.stack(self._project(longitude, latitude), axis=1)

    def from_plane(self, points: np.ndarray) -> np.ndarray:
        longitude, latitude = self._project(*np.asarray(points, float).reshape(-1, 2).T, inverse=True)
        return np.stack([latitude, longitude], axis=1)

    def leg_lengths(self, points: np.ndarray) -> np.ndarray:
        latitude, longitude = np.asarray(points, float).reshape(-1, 2).T
        lengths: np.ndarray = self._geod.inv(longitude[:-1], latitude[:-1], longitude[1:], latitude[1:])[2]
        return lengths
