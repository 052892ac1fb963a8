"""The ellipsoid of WGS 84 (NIMA TR8350.2)."""

SEMI_MAJOR = 6378137.0  # m
FLATTENING = 1.0 / 298.257223563
E2 = FLATTENING * (2.0 - FLATTENING)  # square of the first eccentricity
