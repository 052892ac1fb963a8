"""What stands in a street, by name; each maker gives a list of (mesh, label) about its foot, the
front along +x or +y as it says.
"""

from __future__ import annotations

from semloc_logs.simulation.meshes.fences import (
    fence,
    garden_wall,
    guard_rail,
    pedestrian_rail,
    retaining_wall,
)
from semloc_logs.simulation.meshes.furniture import person, pole, shelter, street_clutter, wires
from semloc_logs.simulation.meshes.greenery import bush, hedge, ivy, tufts
from semloc_logs.simulation.meshes.shapes import Parts, Rng, resample, snow_cover
from semloc_logs.simulation.meshes.trees import tree
from semloc_logs.simulation.meshes.vehicles import (
    bicycle_stand,
    bus,
    camper,
    car,
    railway_wagon,
    rider,
    trailer,
    tram,
    truck,
    two_wheeler,
    van,
)

__all__ = [
    "Parts",
    "Rng",
    "bicycle_stand",
    "bus",
    "bush",
    "camper",
    "car",
    "fence",
    "garden_wall",
    "guard_rail",
    "hedge",
    "ivy",
    "moving_vehicle",
    "parked_vehicle",
    "pedestrian_rail",
    "person",
    "pole",
    "railway_wagon",
    "resample",
    "retaining_wall",
    "rider",
    "shelter",
    "snow_cover",
    "street_clutter",
    "trailer",
    "tram",
    "tree",
    "truck",
    "tufts",
    "two_wheeler",
    "van",
    "wires",
]


def parked_vehicle(rng: Rng) -> Parts:
    """What stands on a parking place: mostly cars, now and then a van, a camper, a trailer, a
    motorcycle or a lorry.
    """
    kind = rng.random()
    for share, make in ((0.83, car), (0.94, van), (0.955, camper), (0.97, trailer)):
        if kind < share:
            return make(rng)
    if kind < 0.98:
        return truck(rng, articulated=0.0)
    return two_wheeler(rng, motor=True)


def moving_vehicle(rng: Rng) -> Parts:
    """What drives on a road: cars, vans, lorries, buses, riders, and now and then a tram."""
    kind = rng.random()
    for share, make in ((0.62, car), (0.74, van), (0.82, truck), (0.89, bus), (0.92, tram)):
        if kind < share:
            return make(rng)
    return rider(rng)
