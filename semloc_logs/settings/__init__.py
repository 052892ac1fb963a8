"""All settings with their defaults beside them: defaults < YAML file < environment
(``SEMLOC_FUSION__VOXEL_SIZE``) < flags.

``sections`` has every setting, ``configuration`` puts them together and fills in the lengths that
follow the voxel size, ``sources`` reads them. Unknown keys are refused at every level, by name.
"""

from semloc_logs.settings.configuration import STREET_VOXEL, TABLE_SECTIONS, Resolved, Settings
from semloc_logs.settings.sections import (
    Fusion,
    Labels,
    Logs,
    ResolvedClosures,
    ResolvedFusion,
    ResolvedOptimize,
    ResolvedQuery,
    Training,
)
from semloc_logs.settings.sources import choices, load, read_yaml, validated

__all__ = [
    "STREET_VOXEL",
    "TABLE_SECTIONS",
    "Fusion",
    "Labels",
    "Logs",
    "Resolved",
    "ResolvedClosures",
    "ResolvedFusion",
    "ResolvedOptimize",
    "ResolvedQuery",
    "Settings",
    "Training",
    "choices",
    "load",
    "read_yaml",
    "validated",
]
