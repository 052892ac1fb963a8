"""The sections of the settings: every setting with its default, its unit and its meaning.

Lengths that are ``None`` follow the voxel size (0.30 m is the paper's street scale; a room at
0.05 m is a street in miniature).
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

MOST_VOXELS = 1000
_UNIT = 1e-2  # of a quaternion's squared length, off 1: people write few digits
_LARGEST_OFFSET = 2e9  # s, of stamps: more than from 1970 to now
LabelSource = Literal["auto", "log", "onnx", "geometry", "uniform"]
Pose = tuple[float, float, float, float, float, float, float]  # x, y, z, qx, qy, qz, qw


class Section(BaseModel):
    """Refuses unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Logs(Section):
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


class Fusion(Section):
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


class Labels(Section):
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


class Descriptor(Section):
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


class Query(Section):
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


class Closures(Section):
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
        description="whether sessions whose poses do not fit their range data, and pairs whose"
        " mountings contradict each other, get closures, too",
    )
    rejected_per_query: int = Field(
        3, ge=0, description="best rejected hypotheses of a query that are reported"
    )


class Optimize(Section):
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


class Training(Section):
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


class Plain(Section):
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
