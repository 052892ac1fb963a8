"""The systems of the experiments by name. A module of a system is imported when it is needed, so
that libraries of the extra ``baselines`` may be missing.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from semloc_logs.errors import SettingsError, did_you_mean
from semloc_logs.experiments.system import System
from semloc_logs.settings import Resolved

MODULES = "semloc_logs.experiments.systems"


@dataclass(frozen=True, slots=True)
class SystemOptions:
    """With what a system is made: ``settings``; ``folder`` of its own, where it may keep what it
    has trained; ``quick``: a small scene that must be done within a minute; ``seed``; the ``name``
    of its row; ``weights``: a folder of networks that were trained before.
    """

    settings: Resolved
    folder: Path
    quick: bool = False
    seed: int = 0
    name: str = ""
    weights: Path | None = None


MakeSystem = Callable[[SystemOptions], System]


@dataclass(frozen=True, slots=True)
class Entry:
    """A row of the table: ``name`` on the command line, ``title`` in figures, ``made_by``:
    ``module:function`` below ``systems`` that takes :class:`SystemOptions`.

    ``extra``: the optional dependencies that it needs; ``frames``: consecutive views of a query (5
    for *acc.*); ``needs_pictures``: it works on pictures, and cannot run without a camera;
    ``remark``: printed below the table.
    """

    name: str
    title: str
    made_by: str
    extra: str = ""
    frames: int = 1
    needs_pictures: bool = False
    remark: str = ""


# our pipeline and the paper's plain method
OURS: tuple[Entry, ...] = (
    Entry("paper-semantic", "Paper (semantic)", "own_rows:make_plain"),
    Entry("paper-geometric", "Paper (geometric)", "own_rows:make_plain"),
    Entry("paper-acc", "Paper (semantic, acc.)", "own_rows:make_plain", frames=5),
    Entry("ours", "Ours", "own_rows:make_ours"),
    Entry("ours-acc", "Ours (acc.)", "own_rows:make_ours", frames=5),
)

# the systems that the paper compares with, and the peers of today
BASELINES: tuple[Entry, ...] = (
    Entry(
        "sift",
        "SIFT",
        "pictures.sift:make_sift",
        needs_pictures=True,
        remark="Words are learnt from the database; points come from the depth of its pictures.",
    ),
    Entry("dsp-sift", "DSP-SIFT", "pictures.sift:make_dsp_sift", needs_pictures=True),
    Entry(
        "mser",
        "MSER + DSP-SIFT",
        "pictures.sift:make_mser",
        needs_pictures=True,
        remark="Regions are circles of their area, upright as in SIFT.",
    ),
    Entry(
        "vip",
        "VIP",
        "pictures.ground_patches:make_vip",
        needs_pictures=True,
        remark="The paper matched hand-picked road by VIP and left it out of its figure.",
    ),
    Entry(
        "dense-vlad",
        "DenseVLAD",
        "pictures.dense_vlad:make_dense_vlad",
        needs_pictures=True,
        remark="Words and principal components are learnt from the database.",
    ),
    Entry("fpfh", "FPFH", "shapes.fpfh:make_fpfh", extra="sim"),
    Entry("cgf", "CGF", "shapes.spherical_histograms:make_cgf", extra="sim"),
    Entry(
        "3dmatch",
        "3DMatch",
        "shapes.distance_volumes:make_3dmatch",
        extra="sim",
        remark="The network is smaller than the authors', for a CPU.",
    ),
    Entry(
        "posenet",
        "PoseNet",
        "pictures.pose_regression:make_posenet",
        needs_pictures=True,
        remark="The network is smaller than the authors', for a CPU.",
    ),
    Entry(
        "dsac",
        "DSAC",
        "pictures.scene_coordinates:make_dsac",
        needs_pictures=True,
        remark="The paper got no meaningful poses from DSAC on its smallest sequence.",
    ),
    Entry(
        "scan-context",
        "Scan Context + GICP",
        "scan_registration:make_scan_context",
        remark="Without the extra 'baselines' our own fit on points takes the part of GICP.",
    ),
    Entry(
        "kiss-matcher",
        "Scan Context + KISS-Matcher",
        "scan_registration:make_kiss_matcher",
        extra="baselines",
    ),
    Entry(
        "map-closures",
        "MapClosures + GICP",
        "scan_registration:make_map_closures",
        extra="baselines",
        remark="A local map is one view, as large as a query; it is made for 100 m of driving.",
    ),
)


# our pipeline without one of its parts (`--systems all-ablations`)
ABLATIONS: tuple[Entry, ...] = tuple(
    Entry(name, title, "own_rows:make_ablation", frames=5)
    for name, title in (
        ("ours-no-classes", "Ours (acc.), words without classes"),
        ("ours-every-heading", "Ours (acc.), every heading described"),
        ("ours-alone", "Ours (acc.), query subvolumes alone"),
        ("ours-stride-4", "Ours (acc.), subvolumes every 4 voxels"),
        ("ours-one-neighbour", "Ours (acc.), one neighbour"),
        ("ours-no-free-space", "Ours (acc.), free space ignored"),
        ("ours-not-refined", "Ours (acc.), not refined"),
        ("ours-no-contrast", "Ours (acc.), no contrastive term"),
        ("ours-64", "Ours (acc.), N = 64"),
        ("ours-512", "Ours (acc.), N = 512"),
    )
)
GROUPS = {"ours": OURS, "baselines": BASELINES, "ablations": ABLATIONS}


class NotInstalledError(SettingsError):
    """A library of an extra is missing."""


def entries(names: Iterable[str] = ()) -> list[Entry]:
    """The entries called ``names``, or of groups of ``GROUPS``; without names all but the
    ablations. SettingsError for an unknown one.
    """
    known: dict[str, tuple[Entry, ...]] = {
        entry.name: (entry,) for entry in (*OURS, *BASELINES, *ABLATIONS)
    }
    known |= {f"all-{name}": group for name, group in GROUPS.items()}
    by_name: dict[str, Entry] = {}
    for name in [*names] or ["all-ours", "all-baselines"]:
        if name not in known:
            raise SettingsError(
                f"Unknown system '{name}'.{did_you_mean(name, known)} "
                f"There are {', '.join(known) or 'none'}."
            )
        by_name |= {entry.name: entry for entry in known[name]}
    return [*by_name.values()]


def make_system(entry: Entry, options: SystemOptions) -> System:
    """The system of an entry. NotInstalledError when its libraries are missing."""
    module, _, function = entry.made_by.partition(":")
    try:
        make: MakeSystem = getattr(importlib.import_module(f"{MODULES}.{module}"), function)
        return make(options)
    except ModuleNotFoundError as problem:
        if (problem.name or "").startswith("semloc_logs"):
            raise
        remedy = (
            f"pip install 'semloc_logs[{entry.extra}]'"
            if entry.extra
            else f"install {problem.name}"
        )
        raise NotInstalledError(
            f"{entry.title} needs {problem.name}, which is not installed: {remedy}."
        ) from None
