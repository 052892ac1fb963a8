"""All settings with their defaults beside them: defaults < YAML file < environment
(``SEMLOC_FUSION__VOXEL_SIZE``) < flags.

Unknown keys are refused at every level, by name. Lengths that are ``None`` follow the voxel size
(0.30 m is the paper's street scale; a room at 0.05 m is a street in miniature) and are filled in by
:meth:`Settings.resolved`, the only place that does so.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from semloc_logs.errors import SettingsError, did_you_mean
from semloc_logs.schemas import names, read_text

STREET_VOXEL = 0.30
# sections that the tables of a workspace depend on, and settings in them that change no table
TABLE_SECTIONS = ("fusion", "labels", "descriptor", "query", "closures")
OF_MACHINE = frozenset({"logs.memory", "labels.threads", "training.method"})
MOST_VOXELS = 1000
_UNIT = 1e-2  # of a quaternion's squared length, off 1: people write few digits
_MOST_BYTES = 1 << 20  # of a YAML file
_LARGEST_OFFSET = 2e9  # s, of stamps: more than from 1970 to now
_BY_TOPIC = "logs.time_offset."  # the rest of such a key is a topic, which may have dots
LabelSource = Literal["auto", "log", "onnx", "geometry", "uniform"]


Pose = tuple[float, float, float, float, float, float, float]  # x, y, z, qx, qy, qz, qw


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Logs(_Section):
    """How logs are read; everything here overrules what the log itself says."""

    stamps: Literal["auto", "header", "log"] = Field(
        "auto",
        description="times of messages: header: their own stamps; log: when they were recorded;"
        " auto: their own, unless all stamps of a topic are 0",
    )
    time_offset: dict[str, float] = Field(
        default_factory=dict,
        description="seconds added to the stamps of a topic, by topic",
    )
    depth_unit: float | None = Field(
        None,
        gt=0,
        le=1,
        description="metres of one step of a depth image; default 0.001 of whole numbers and 1 of"
        " 32FC1, as their encodings are defined",
    )
    mountings: dict[str, Pose] = Field(
        default_factory=dict,
        description="pose of a frame in the base frame, by frame name: [x, y, z, qx, qy, qz, qw]"
        " in metres, instead of the transforms of the log",
    )
    up: str = Field(
        "auto",
        description="up in the session frame (in the base frame of a log without poses): an axis"
        " such as +z or -y, or a vector X,Y,Z, refined within 20 degrees; auto: from the IMU, else"
        " from the ground, walls and motion",
    )
    memory: int = Field(
        2 << 30,
        ge=64 << 20,
        description="bytes of a log that may be in memory at once, decompressed",
    )

    @field_validator("time_offset")
    @classmethod
    def _check_offsets(cls, offsets: dict[str, float]) -> dict[str, float]:
        """Offsets keep every stamp within 64 bits of nanoseconds."""
        if any(abs(seconds) > _LARGEST_OFFSET for seconds in offsets.values()):
            raise ValueError(f"an offset is at most {_LARGEST_OFFSET:g} s")
        return offsets

    @field_validator("up", mode="before")
    @classmethod
    def _check_up(cls, value: Any) -> Any:
        # YAML makes a list of [0, 0, 1]
        text = ",".join(map(str, value)) if isinstance(value, list | tuple) else value
        if isinstance(text, str):
            _direction(text)
        return text

    @property
    def up_vector(self) -> tuple[float, float, float] | None:
        """The direction ``up``, of any length; None for auto."""
        return _direction(self.up)

    def __hash__(self) -> int:
        return hash(self.model_dump_json())  # a mapping has no hash of its own

    @model_validator(mode="after")
    def _check(self) -> Logs:
        for frame, pose in self.mountings.items():
            if abs(sum(v * v for v in pose[3:]) - 1.0) > _UNIT:
                raise ValueError(
                    f"the last four numbers of mountings.{frame} have to be a unit quaternion "
                    f"qx, qy, qz, qw"
                )
        return self


class Fusion(_Section):
    """Keyframes, submaps and the voxel map (paper 3.1)."""

    voxel_size: float = Field(0.30, gt=0.005, le=5.0, description="edge of a voxel (m)")
    min_range: float | None = Field(
        None,
        ge=0,
        description="points nearer than this to the sensor are dropped (m); default 3 voxels",
    )
    max_range: float | None = Field(
        None,
        gt=0,
        description="points farther than this are not fused, only carved (m); default 50 m at 0.30"
        " m voxels",
    )
    keyframe_distance: float | None = Field(
        None, ge=0, description="a frame becomes a keyframe after this travel (m); default 2 voxels"
    )
    keyframe_angle: float = Field(0.175, gt=0, description="or after this turn (rad)")
    keyframe_resolution: float | None = Field(
        None,
        gt=0,
        description="keyframes keep one point a cell of this size (m); default a third of a voxel",
    )
    submap_length: float | None = Field(
        None, gt=0, description="length of road in a submap (m); default 100 m at 0.30 m voxels"
    )
    submap_overlap: float = Field(
        0.25, ge=0.0, lt=1.0, description="share of a submap that the next one repeats"
    )
    depth_noise: float = Field(
        0.0019,
        ge=0,
        le=1,
        description="standard deviation of a depth image: 0.0012 m + this (1/m) times (z - 0.4"
        " m)^2; structured light",
    )
    disparity_noise: float = Field(
        0.2, gt=0, le=10, description="standard deviation of a stereo pair's disparity (px)"
    )
    hit: float = Field(
        0.85, ge=0.05, le=6, description="log-odds added to a voxel that a ray ends in"
    )
    miss: float = Field(
        0.40, ge=0.05, le=6, description="log-odds taken from a voxel that a ray passes"
    )
    odometry: Literal["none", "lidar"] = Field(
        "none",
        description="lidar: poses from LIDAR odometry (KISS-ICP, the extra 'odometry') instead of"
        " the poses of the log",
    )
    clamp: tuple[float, float] = Field(
        (-2.0, 3.5), description="bounds of the log-odds (OctoMap), within +-6"
    )

    @model_validator(mode="after")
    def _check(self) -> Fusion:
        if not -6 <= self.clamp[0] < 0 < self.clamp[1] <= 6:  # kept as int8 in units of 1/20
            raise ValueError("clamp needs a bound in [-6, 0) and one in (0, 6]")
        # a sweep is carved in a dense grid
        if self.max_range is not None and self.max_range > MOST_VOXELS * self.voxel_size:
            raise ValueError(f"max_range reaches more than {MOST_VOXELS} voxels")
        return self


class Labels(_Section):
    """Source of the classes (paper 3.1); recorded in session.json and in every table."""

    source: LabelSource = Field(
        "auto",
        description="auto: labels of the log if it has any, else geometry; uniform: one class",
    )
    space: str | None = Field(
        None,
        description="label space of the log's ids, shipped (schemas/label_spaces) or a YAML file;"
        " default: as the log says, else guessed",
    )
    model: Path | None = Field(
        None, description="ONNX model that labels the camera pictures, for source onnx"
    )
    spec: Path | None = Field(
        None, description="YAML file that describes input and output of the model"
    )
    threads: int = Field(1, ge=1, le=64, description="threads of the model in each job")
    memory: int = Field(
        4 << 30,
        ge=16 << 20,
        description="bytes that the model and its results may take in each job",
    )
    erode: int = Field(
        2,
        ge=0,
        le=50,
        description="pixels beside the border of two labels in a picture that label nothing",
    )
    unseen: Literal["unlabelled", "geometry"] = Field(
        "unlabelled",
        description="what points get that no picture shows, where labels come from pictures",
    )


class Descriptor(_Section):
    """Subvolumes and their descriptors (paper 3.2)."""

    variant: Literal["auto", "semantic", "geometric"] = Field(
        "auto", description="auto: semantic where labels come from a log, else geometric"
    )
    headings: int = Field(
        20,
        ge=4,
        multiple_of=4,
        description="yaw hypotheses about gravity: maps are described in a quarter of them, the"
        " rest is free",
    )
    stride: Literal[4, 8] = Field(
        8, description="database subvolumes every so many voxels in x and y (4 or 8)"
    )
    query_stride: Literal[4, 8] = Field(
        8, description="query subvolumes every so many voxels in x and y (4 or 8)"
    )
    reach: float | None = Field(
        None,
        description="database subvolumes lie this near to the road (m); default 30 m at 0.30 m"
        " voxels",
    )
    min_occupied: int = Field(
        40, ge=1, description="subvolumes with fewer occupied voxels are not described"
    )
    weights: Path | None = Field(
        None, description="safetensors file instead of the shipped weights"
    )
    vocabulary: Path | None = Field(
        None, description="safetensors file instead of the shipped vocabulary"
    )


class Query(_Section):
    """Which queries are made (paper 3, 4.4)."""

    frames: int = Field(
        5,
        ge=1,
        description="keyframes fused into a query, as many before its own as after it; acc. of the"
        " paper is 5",
    )
    length: float | None = Field(
        None,
        gt=0,
        description="or all keyframes of this stretch of road (m), at most twice"
        " fusion.submap_length",
    )
    every: float | None = Field(
        None, gt=0, description="distance between queries (m); default 2 m at 0.30 m voxels"
    )
    every_angle: float = Field(0.349, gt=0, description="or turn between queries (rad)")
    radius: float | None = Field(
        None,
        gt=0,
        description="a query map holds points this near to its keyframes (m); default 24 m at 0.30"
        " m voxels",
    )


class Closures(_Section):
    """From word matches to accepted closures (paper 3.4, 3.5)."""

    neighbours: int = Field(5, ge=1, description="nearest database words of each query word (K)")
    probes: int = Field(
        8, ge=1, description="nearest vocabulary cells searched for each query word"
    )
    every: float | None = Field(
        None,
        gt=0,
        description="length of road that is searched in another session by its best query first,"
        " and by the others where that one finds a place (m); default four queries",
    )
    min_votes: float = Field(
        3.0,
        ge=0,
        description="weight of a query's words that agree about a place in another session, below"
        " which it is not searched there, nor where chance brings as much; 0: all queries are"
        " searched in all sessions. The one query of a short session is searched in any case",
    )
    hypotheses: int = Field(
        32,
        ge=1,
        description="pooled hypotheses of a query in each target session that are verified",
    )
    places: int = Field(
        4,
        ge=1,
        description="submaps of each target session that a query is verified in: those whose words"
        " agree best",
    )
    candidates: int = Field(
        4,
        ge=1,
        description="best hypotheses of a query in each target session that are aligned on points;"
        " wrong ones count too, for they tell which places are ambiguous",
    )
    surface_keyframes: int = Field(
        9,
        ge=1,
        description="keyframes of a target that a query is aligned with, for each query.radius of"
        " a query's length",
    )
    kappa: float = Field(10.0, gt=0, description="kappa of the paper in voxels (3 m at 0.30 m)")
    min_probability: float = Field(
        0.99, ge=0.0, le=1.0, description="closures below this are rejected"
    )
    exclude_seconds: float = Field(
        30.0,
        ge=0,
        description="within a session, keyframes nearer in time than this are not a revisit",
    )
    exclude_distance: float | None = Field(
        None,
        ge=0,
        description="nor nearer along the road than this (m); default 50 m at 0.30 m voxels",
    )
    misfits: bool = Field(
        False,
        description="whether sessions whose poses do not fit their range data get closures, too",
    )
    rejected_per_query: int = Field(
        3, ge=0, description="best rejected hypotheses of a query that are reported"
    )


class Optimize(_Section):
    """The pose graph of all sessions and their closures."""

    odometry_drift: float = Field(
        0.01, gt=0, le=1, description="share of the road that odometry is off after 100 m"
    )
    odometry_turn_deg: float = Field(
        0.5, gt=0, le=180, description="degrees that odometry turns too much after 100 m"
    )
    closure_sigma: float | None = Field(
        None,
        gt=0,
        description="uncertainty of position (m) of every closure beside its covariance: the maps"
        " drift, too; default 0.1 m at 0.30 m voxels",
    )
    closure_sigma_deg: float = Field(
        0.5, gt=0, le=180, description="the same of its rotation, degrees"
    )
    gravity_sigma_deg: float = Field(
        2.0, gt=0, le=180, description="uncertainty of up in the map frame of a session, degrees"
    )
    gnss: bool = Field(True, description="use satellite fixes where logs have them")
    gnss_sigma: float = Field(
        1.0,
        gt=0,
        description="uncertainty of every satellite fix (m) beside its covariance: errors of"
        " neighbours are alike",
    )
    vertex_spacing: float | None = Field(
        None,
        gt=0,
        description="a pose is solved for after so much road (m), those between follow; default"
        " 5 m at 0.30 m voxels",
    )
    seconds: float = Field(
        300.0, ge=0, description="for the robust solution; Cauchy weights decide after that"
    )


class Training(_Section):
    """The encoder-decoder's training (supplement 1)."""

    method: Literal["ours", "paper"] = Field(
        "ours",
        description="ours; paper: the network of the paper's Fig. 2, on single subvolumes, with"
        " ADADELTA",
    )
    samples: int = Field(250_000, ge=32, description="subvolumes seen, nine of each cut pair")
    scenes: int = Field(
        60, ge=1, description="simulated scenes that pairs are cut from, when no session is given"
    )
    batch: int = Field(12, ge=2, description="pairs of a step")
    latent: int = Field(256, ge=8, le=1024, description="numbers of a descriptor")
    dropout: float = Field(
        0.10, ge=0, lt=1, description="share of the input's voxels that are dropped to unobserved"
    )
    reconstruction_weight: float = Field(
        10.0, description="weight of the reconstruction loss against the prior's"
    )
    occupied_weight: float = Field(10.0, description="weight of occupied voxels within it")
    contrastive_weight: float = Field(
        10.0, ge=0, description="weight of the contrastive term beside completion; 0 is the paper"
    )
    shift: float = Field(
        0.6,
        ge=0,
        description="random shift of the contrastive view, largest per axis (m at 0.30 m voxels)",
    )
    turn: float = Field(
        0.175, ge=0, description="random turn of the contrastive view, largest (rad)"
    )
    tilt: float = Field(
        0.006,
        ge=0,
        description="standard deviation of the incomplete view's vertical, per axis (rad)",
    )
    seed: int = 0


class Plain(_Section):
    """The paper's method as written, in the experiments (paper 3, 4.2 and supplement 1)."""

    headings: int = Field(
        18, ge=1, description="uniformly spaced yaw hypotheses; a query is described in each"
    )
    stride: int = Field(
        8,
        ge=1,
        description="database subvolumes every so many voxels along x, y and z (not in the paper)",
    )
    query_stride: int = Field(
        16,
        ge=1,
        description="query subvolumes every so many voxels (not in the paper, which has several"
        " thousand in all headings)",
    )
    min_occupied: int = Field(
        1, ge=1, description="subvolumes with fewer occupied voxels are not described"
    )
    neighbours: int = Field(5, ge=1, description="nearest database words of each query word (K)")
    kappa: float = Field(
        3.0, gt=0, description="greatest distance of aligned voxels (m at 0.30 m voxels)"
    )
    closest: Literal["observed", "occupied"] = Field(
        "observed",
        description="the voxels that may be closest to an aligned one; observed: free space, too,"
        " as the paper's text has it",
    )
    min_tau: float = Field(
        0.3, ge=0, le=1, description="poses with a smaller share of aligned voxels are left out"
    )
    refined: int = Field(
        100,
        ge=1,
        description="best hypotheses that the iterative closest points refine (the paper: all)",
    )
    iterations: int = Field(
        10, ge=0, description="of the iterative closest points at most (not in the paper)"
    )


class ResolvedFusion(Fusion):
    """The same with every length."""

    min_range: float
    max_range: float
    keyframe_distance: float
    keyframe_resolution: float
    submap_length: float


class ResolvedDescriptor(Descriptor):
    """The same with every length."""

    reach: float


class ResolvedQuery(Query):
    """The same with every length but ``length``, without which ``frames`` counts."""

    every: float
    radius: float


class ResolvedClosures(Closures):
    """The same with every length."""

    every: float
    exclude_distance: float


class ResolvedOptimize(Optimize):
    """The same with every length."""

    closure_sigma: float
    vertex_spacing: float


class Settings(_Section):
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
        """YAML that :func:`load` reads back to the same settings."""
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


def _direction(text: str) -> tuple[float, float, float] | None:
    """A vector from an axis or from three numbers; None for auto. ValueError for other text."""
    if text == "auto":
        return None
    if len(text) == 2 and text[0] in "+-" and text[1] in "xyz":
        sign = 1.0 if text[0] == "+" else -1.0
        x, y, z = (sign if axis == text[1] else 0.0 for axis in "xyz")
    else:
        try:
            x, y, z = (float(number) for number in text.split(","))
        except ValueError:
            raise ValueError("up is auto, an axis such as +z, or a vector X,Y,Z") from None
    if not 1e-9 < math.hypot(x, y, z) < math.inf:
        raise ValueError("up needs a vector of finite length other than zero")
    return x, y, z


def _given(value: float | None, default: float) -> float:
    return default if value is None else value


class _Loader(yaml.SafeLoader):
    """Without aliases: a few lines of aliases of aliases stand for more than any memory holds."""

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            raise yaml.composer.ComposerError(None, None, "aliases are not supported", None)
        return super().compose_node(parent, index)


def _from_yaml(text: str) -> Any:
    """ValueError for other text; the values of tags and dates raise many other types."""
    try:
        return yaml.load(text, Loader=_Loader)
    except (
        yaml.YAMLError,
        ValueError,
        TypeError,
        LookupError,
        AttributeError,
        RecursionError,
    ) as problem:
        raise ValueError(" ".join(str(problem).split())[:200].rstrip(".")) from None


def read_yaml(path: Path, what: str) -> Any:
    """The content of the YAML file ``path``. SettingsError, which calls it ``what``, when it cannot
    be read or is larger than 1 MiB.
    """
    try:
        with path.open("rb") as file:
            content = file.read(_MOST_BYTES + 1)
        if len(content) > _MOST_BYTES:
            raise SettingsError(f"{what} {path} is larger than a megabyte: name another file.")
        return _from_yaml(content.decode())
    except (OSError, ValueError) as problem:
        raise SettingsError(f"{what} {path} cannot be read as YAML: {problem}.") from None


def load(
    file: Path | None = None,
    assignments: Mapping[str, str] | None = None,
    environment: Mapping[str, str] | None = None,
    method: str | None = None,
) -> Settings:
    """Settings from defaults < ``method`` < ``file`` (YAML) < ``environment`` < ``assignments``
    (``key.path`` -> YAML value).

    A ``method`` is a settings file of the package (schemas/methods). Raises SettingsError naming
    the key when it is unknown or its value impossible.
    """
    merged: dict[str, Any] = {}
    if file is not None:
        content = read_yaml(file, "Settings file")
        if content is not None and not isinstance(content, dict):
            raise SettingsError(
                f"Settings file {file} does not hold a mapping of sections such as 'fusion:'."
            )
        # a section may be empty
        merged = {str(k): {} if v is None else v for k, v in (content or {}).items()}
    if method is not None:
        for section, values in _method(method).items():
            given = merged.setdefault(section, {})
            merged[section] = {**values, **given} if isinstance(given, dict) else given
    for name, value in (environment or {}).items():
        if name.startswith("SEMLOC_") and "__" in name:
            _assign(merged, name[len("SEMLOC_") :].lower().replace("__", "."), value)
    for key, value in (assignments or {}).items():
        _assign(merged, key, value)
    return validated(merged)


def _method(name: str) -> dict[str, dict[str, Any]]:
    """The sections of a named method; SettingsError for another name."""
    known = names("methods", ".yaml")
    if name not in known:
        raise SettingsError(f"Unknown method '{name}': there are {', '.join(known)}.")
    content: dict[str, dict[str, Any]] = _from_yaml(read_text(f"methods/{name}.yaml"))
    return content


def validated(content: Mapping[str, Any]) -> Settings:
    """The settings of a mapping of sections. SettingsError names a key that is wrong."""
    try:
        return Settings.model_validate(content)
    except ValidationError as problem:
        first = problem.errors()[0]
        key = ".".join(str(p) for p in first["loc"])
        if first["type"] == "extra_forbidden":
            raise SettingsError(
                f"Unknown setting '{key}': 'semloc run --dump-config' prints every key."
                f"{did_you_mean(key, _keys())}"
            ) from None
        raise SettingsError(
            f"Setting '{key}' cannot be {first.get('input')!r}: {first['msg']}."
        ) from None


def _keys() -> list[str]:
    """Every section, and every setting by its key path."""
    sections = {name: type(values).model_fields for name, values in Settings()}
    return [*sections, *(f"{name}.{key}" for name, fields in sections.items() for key in fields)]


def choices() -> dict[str, tuple[str, ...]]:
    """The key of every setting, with its values where it has a few fixed ones."""
    found: dict[str, tuple[str, ...]] = {}
    for section, values in Settings():
        for name, field in type(values).model_fields.items():
            kinds = (field.annotation, *get_args(field.annotation))
            fixed = [v for kind in kinds if get_origin(kind) is Literal for v in get_args(kind)]
            of_switch = ("true", "false") if bool in kinds else ()
            found[f"{section}.{name}"] = tuple(map(str, fixed)) or of_switch
    return found


def _assign(tree: dict[str, Any], key: str, value: str) -> None:
    if key.startswith(_BY_TOPIC):
        *parents, last = (*_BY_TOPIC.strip(".").split("."), key.removeprefix(_BY_TOPIC))
    else:
        *parents, last = key.split(".")
    for part in parents:
        child = tree.setdefault(part, {})
        if not isinstance(child, dict):
            raise SettingsError(f"Unknown setting '{key}': '{part}' is not a section.")
        tree = child
    try:
        tree[last] = _from_yaml(value)
    except ValueError:
        raise SettingsError(f"Setting '{key}' has a value that is not YAML: {value!r}.") from None
