"""UTM coordinates on WGS 84 by Krueger's series of the transverse Mercator projection.

Karney: Transverse Mercator with an accuracy of a few nanometers, Journal of Geodesy 85, 2011,
equations 7 to 9, 11 and 35, here to the fourth order: below a millimetre in a zone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semloc_logs.arrays import F64
from semloc_logs.numerics.wgs84 import E2, FLATTENING, SEMI_MAJOR

SCALE = 0.9996
FALSE_EASTING = 500_000.0
FALSE_NORTHING = 10_000_000.0  # south of the equator
_N = FLATTENING / (2.0 - FLATTENING)
_RADIUS = SEMI_MAJOR / (1.0 + _N) * (1.0 + _N**2 / 4.0 + _N**4 / 64.0)
_ALPHA = (
    _N / 2.0 - 2.0 / 3.0 * _N**2 + 5.0 / 16.0 * _N**3 + 41.0 / 180.0 * _N**4,
    13.0 / 48.0 * _N**2 - 3.0 / 5.0 * _N**3 + 557.0 / 1440.0 * _N**4,
    61.0 / 240.0 * _N**3 - 103.0 / 140.0 * _N**4,
    49561.0 / 161280.0 * _N**4,
)


@dataclass(frozen=True, slots=True)
class UtmZone:
    """A zone of 6 degrees, by its number, and the hemisphere."""

    number: int
    is_south: bool

    @classmethod
    def of(cls, latitude_deg: float, longitude_deg: float) -> UtmZone:
        """The regular zone of a point; the exceptions of Norway are not made."""
        number = int((longitude_deg + 180.0) // 6.0) % 60 + 1
        return cls(number, latitude_deg < 0)

    @property
    def epsg(self) -> int:
        """The code of the projected coordinate system."""
        return (32700 if self.is_south else 32600) + self.number

    @property
    def central_meridian_deg(self) -> float:
        return 6.0 * self.number - 183.0

    def wkt(self) -> str:
        """Well-known text 1, as LAS files have it (OGC 01-009)."""
        name = f"WGS 84 / UTM zone {self.number}{'S' if self.is_south else 'N'}"
        northing = FALSE_NORTHING if self.is_south else 0.0
        return (
            f'PROJCS["{name}",GEOGCS["WGS 84",DATUM["WGS_1984",'
            'SPHEROID["WGS 84",6378137,298.257223563,AUTHORITY["EPSG","7030"]],'
            'AUTHORITY["EPSG","6326"]],PRIMEM["Greenwich",0,AUTHORITY["EPSG","8901"]],'
            'UNIT["degree",0.0174532925199433,AUTHORITY["EPSG","9122"]],'
            'AUTHORITY["EPSG","4326"]],PROJECTION["Transverse_Mercator"],'
            'PARAMETER["latitude_of_origin",0],'
            f'PARAMETER["central_meridian",{self.central_meridian_deg:g}],'
            f'PARAMETER["scale_factor",{SCALE}],PARAMETER["false_easting",{FALSE_EASTING:g}],'
            f'PARAMETER["false_northing",{northing:.0f}],'
            'UNIT["metre",1,AUTHORITY["EPSG","9001"]],AXIS["Easting",EAST],'
            f'AXIS["Northing",NORTH],AUTHORITY["EPSG","{self.epsg}"]]'
        )

    def project(self, geodetic: F64) -> F64:
        """Easting, northing and height (n, 3) of latitudes, longitudes (degrees) and heights."""
        latitude = np.radians(geodetic[:, 0])
        longitude = np.radians(geodetic[:, 1] - self.central_meridian_deg)
        eccentricity = np.sqrt(E2)
        tangent = np.tan(latitude)
        sigma = np.sinh(
            eccentricity * np.arctanh(eccentricity * tangent / np.sqrt(1.0 + tangent**2))
        )
        conformal = tangent * np.sqrt(1.0 + sigma**2) - sigma * np.sqrt(1.0 + tangent**2)
        xi = np.arctan2(conformal, np.cos(longitude))
        eta = np.arcsinh(np.sin(longitude) / np.hypot(conformal, np.cos(longitude)))
        north = xi.copy()
        east = eta.copy()
        for k, alpha in enumerate(_ALPHA, 1):
            north += alpha * np.sin(2 * k * xi) * np.cosh(2 * k * eta)
            east += alpha * np.cos(2 * k * xi) * np.sinh(2 * k * eta)
        easting = FALSE_EASTING + SCALE * _RADIUS * east
        northing = SCALE * _RADIUS * north + (FALSE_NORTHING if self.is_south else 0.0)
        return np.stack([easting, northing, geodetic[:, 2]], axis=1)
