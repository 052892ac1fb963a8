"""The whole configuration: as it was given, and with every length filled in."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import yaml

from semloc_logs.errors import SettingsError
from semloc_logs.settings.sections import (
    Closures,
    Descriptor,
    Fusion,
    Labels,
    Logs,
    Optimize,
    Plain,
    Query,
    ResolvedClosures,
    ResolvedDescriptor,
    ResolvedFusion,
    ResolvedOptimize,
    ResolvedQuery,
    Section,
    Training,
)

STREET_VOXEL = 0.30
# sections that the tables of a workspace depend on, and settings in them that change no table
TABLE_SECTIONS = ("fusion", "labels", "descriptor", "query", "closures")
OF_MACHINE = frozenset({"logs.memory", "labels.threads", "training.method"})


class Settings(Section):
    """The whole configuration as given; see each section."""

    logs: Logs = Logs()
    fusion: Fusion = Fusion()
    labels: Labels = Labels()
    descriptor: Descriptor = Descriptor()
    query: Query = Query()
    closures: Closures = Closures()
    optimize: Optimize = Optimize()
    training: Training = Training()
    plain: Plain = Plain()

    def resolved(self) -> Resolved:
        """The same settings with every ``None`` length filled in from the voxel size, and absolute
        paths.

        Raises SettingsError where lengths do not go together.
        """
        fusion = self.fusion
        v = fusion.voxel_size
        scale = v / STREET_VOXEL
        submap_length = _given(fusion.submap_length, 100 * scale)
        if self.query.length is not None and self.query.length > 2 * submap_length:
            raise SettingsError(
                f"Setting 'query.length' cannot be {self.query.length:g} m: a query is looked for"
                f" in submaps of {submap_length:g} m, and may be twice as long; make"
                " fusion.submap_length larger, too."
            )
        query_every = _given(self.query.every, 2 * scale)
        lengths: dict[str, dict[str, float]] = {
            "fusion": {
                "min_range": 3 * v,
                "max_range": 50 * scale,
                "keyframe_distance": 2 * v,
                "keyframe_resolution": v / 3,
                "submap_length": 100 * scale,
            },
            "descriptor": {"reach": 30 * scale},
            "query": {"every": query_every, "radius": 24 * scale},
            "closures": {"exclude_distance": 50 * scale, "every": 4 * query_every},
            "optimize": {"closure_sigma": v / 3, "vertex_spacing": 5 * scale},
        }
        content = self.model_dump()
        for section, defaults in lengths.items():
            for name, length in defaults.items():
                content[section][name] = _given(content[section][name], length)
        # a workspace keeps them, and its next command may run elsewhere
        for values in content.values():
            values |= {k: v.absolute() for k, v in values.items() if isinstance(v, Path)}
        return Resolved.model_validate(content)

    def tables(self, *sections: str) -> dict[str, dict[str, Any]]:
        """The named sections, of those only the settings that tables depend on."""
        dumped = self.model_dump(mode="json", include=set(sections))
        return {
            section: {k: v for k, v in values.items() if f"{section}.{k}" not in OF_MACHINE}
            for section, values in dumped.items()
        }

    def fingerprint(self, *sections: str) -> str:
        """Hash of the named sections: what a stage's outputs depend on."""
        dumped = json.dumps(self.tables(*sections), sort_keys=True)
        return hashlib.sha256(dumped.encode()).hexdigest()[:16]

    def given(self) -> dict[str, Any]:
        """The settings that were given, by key path, as JSON has them; defaults are left out."""
        return {
            f"{section}.{name}": value
            for section in self.model_fields_set
            for name, value in getattr(self, section)
            .model_dump(mode="json", exclude_unset=True)
            .items()
        }

    def dump(self) -> str:
        """YAML that ``settings.load`` reads back to the same settings."""
        return str(yaml.safe_dump(self.model_dump(mode="json"), sort_keys=False))


class Resolved(Settings):
    """The configuration as the stages use it: every length is there."""

    fusion: ResolvedFusion
    descriptor: ResolvedDescriptor
    query: ResolvedQuery
    closures: ResolvedClosures
    optimize: ResolvedOptimize

    def resolved(self) -> Resolved:
        return self

    def differences(self) -> dict[str, dict[str, Any]]:
        """The settings of the tables that neither defaults nor the voxel size give, by section."""
        voxel_size = self.fusion.voxel_size
        expected = Settings(fusion=Fusion(voxel_size=voxel_size)).resolved().tables(*TABLE_SECTIONS)
        out = {
            section: {k: v for k, v in values.items() if v != expected[section][k]}
            for section, values in self.tables(*TABLE_SECTIONS).items()
        }
        if voxel_size != STREET_VOXEL:
            out["fusion"]["voxel_size"] = voxel_size
        return {section: values for section, values in out.items() if values}


def _given(value: float | None, default: float) -> float:
    return default if value is None else value
