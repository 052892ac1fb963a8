"""What differs between two drives through the same town: season, snow, roadworks, houses built or
gone, time of day.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from semloc_logs.errors import SettingsError

SEASONS = ("summer", "autumn", "winter", "snow")
DAYTIMES = ("noon", "evening", "overcast")


@dataclass(frozen=True, slots=True)
class Condition:
    """Conditions of a session; SettingsError for values that make no sense.

    ``number`` draws what changes from drive to drive (parked vehicles, people, bins); ``season`` is
    one of ``SEASONS`` (in winter and snow deciduous trees are bare); ``roadworks`` is a number of
    sites a kilometre of road; ``rebuilt`` the share of houses built or gone since the first
    session; ``daytime`` is the light of the images.
    """

    number: int = 0
    season: str = "summer"
    roadworks: float = 0.0
    rebuilt: float = 0.0
    daytime: str = "noon"

    def __post_init__(self) -> None:
        if self.season not in SEASONS:
            raise SettingsError(
                f"unknown simulated season {self.season!r}: choose one of {', '.join(SEASONS)}"
            )
        if self.daytime not in DAYTIMES:
            raise SettingsError(
                f"unknown simulated time of day {self.daytime!r}: "
                f"choose one of {', '.join(DAYTIMES)}"
            )
        if not (math.isfinite(self.roadworks) and 0 <= self.roadworks <= 50):
            raise SettingsError(
                f"{self.roadworks} simulated roadworks a kilometre are impossible: "
                "give between 0 and 50"
            )
        if not 0 <= self.rebuilt <= 1:
            raise SettingsError(
                f"a share of {self.rebuilt} rebuilt houses is impossible: give between 0 and 1"
            )

    @property
    def bare(self) -> bool:
        """Whether deciduous plants have no leaves."""
        return self.season in ("winter", "snow")
