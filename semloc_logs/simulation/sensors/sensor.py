"""The sensor that a simulated vehicle carries: which lidar or camera, and how well it measures."""

from __future__ import annotations

from dataclasses import dataclass

from semloc_logs.errors import SettingsError
from semloc_logs.simulation.sensors.camera import CAMERAS
from semloc_logs.simulation.sensors.lidar_models import MODELS

RATES_HZ = 0.05, 10.0  # sweeps or shots a second, least and most
IMU_RATES_HZ = 1.0, 1000.0
MAX_DRIFT = 0.2  # of the odometry, share of the way


@dataclass(frozen=True, slots=True)
class Sensor:
    """A lidar or cameras with the odometry beside it; SettingsError for impossible values.

    ``name`` in ``lidar_models.MODELS`` or ``camera.CAMERAS``; ``rate_hz``: sweeps or shots a
    second; ``columns`` a turn (None: the model's own); ``label_noise``: share of wrong labels, of
    which about half are fixed to places, the others belong to one sweep; ``drift`` of the odometry
    as a share of the way; ``wet`` in [0, 1]: how wet the road is; ``imu_hz``: samples of the IMU a
    second (None: one for each pose).
    """

    name: str = "hdl32"
    rate_hz: float = 2.0
    columns: int | None = None
    label_noise: float = 0.0
    drift: float = 0.007
    wet: float = 0.0
    imu_hz: float | None = None

    def __post_init__(self) -> None:
        if self.name not in (*MODELS, *CAMERAS):
            raise SettingsError(
                f"unknown simulated sensor {self.name!r}: "
                f"choose one of {', '.join((*MODELS, *CAMERAS))}"
            )
        if not RATES_HZ[0] <= self.rate_hz <= RATES_HZ[1]:
            raise SettingsError(
                f"a simulated sensor cannot measure {self.rate_hz} times a second: "
                f"give between {RATES_HZ[0]:g} and {RATES_HZ[1]:g} Hz"
            )
        if not 0 <= self.label_noise <= 1:
            raise SettingsError(
                f"a share of {self.label_noise} wrong labels is impossible: give between 0 and 1"
            )
        if not 0 <= self.drift <= MAX_DRIFT:
            raise SettingsError(
                f"simulated odometry cannot drift by {self.drift} of the way: "
                f"give between 0 and {MAX_DRIFT:g}"
            )
        if not 0 <= self.wet <= 1:
            raise SettingsError(f"a road cannot be wet by {self.wet}: give between 0 and 1")
        if self.imu_hz is not None and not IMU_RATES_HZ[0] <= self.imu_hz <= IMU_RATES_HZ[1]:
            raise SettingsError(
                f"a simulated IMU cannot sample {self.imu_hz} times a second: "
                f"give between {IMU_RATES_HZ[0]:g} and {IMU_RATES_HZ[1]:g} Hz"
            )

    @property
    def is_camera(self) -> bool:
        """Whether it takes pictures and no sweeps."""
        return self.name in CAMERAS
