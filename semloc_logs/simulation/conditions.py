"""What differs between two drives through the same town: season, snow, roadworks, houses built or gone, time of day."""

from __future__ import annotations

from dataclasses import dataclass

SEASONS = ("summer", "autumn", "winter", "snow")
DAYTIMES = ("noon", "evening", "overcast")


@dataclass(frozen=True, slots=True)
class Condition:
    """Conditions of a session.

    ``number`` draws what changes from drive to drive (parked vehicles, people, bins); ``season`` is one of ``SEASONS`` (in winter and
    snow deciduous trees are bare); ``roadworks`` is a number of sites a kilometre; ``rebuilt`` the share of houses built or gone since the
    first session; ``daytime`` is the light of the images.
    """

    number: int = 0
    season: str = "summer"
    roadworks: float = 0.0
    rebuilt: float = 0.0
    daytime: str = "noon"
