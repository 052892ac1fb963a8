"""Options that commands share, and what becomes of them: settings, topics, an engine."""

from __future__ import annotations

import functools
import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from .completion import role_names, setting_keys
from .console import console

if TYPE_CHECKING:
    from semloc_logs.engines import Engine
    from semloc_logs.logs.poses.trajectory_file import TrajectoryFile
    from semloc_logs.settings import Settings

Function = Callable[..., Any]

LEAST_MEMORY = 500e6  # bytes: libraries and compiled loops alone are about 370 MB

FLAGS = {  # options that are short for a setting
    "stamps": "logs.stamps",
    "odometry": "fusion.odometry",
    "seg_model": "labels.model",
    "seg_spec": "labels.spec",
    "query_frames": "query.frames",
    "query_length": "query.length",
    "query_every": "query.every",
    "samples": "training.samples",
    "scenes": "training.scenes",
    "seed": "training.seed",
}
DUMPED = {"work", "config", "assignments", "method", *FLAGS}  # options that --dump-config looks at


class Command(click.Command):
    """A command that needs no arguments when --dump-config is given."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        if "--dump-config" in args and any(p.name == "dump_config" for p in self.params):
            given = self.make_parser(ctx).parse_args(args=list(args))[0]
            for parameter in self.params:
                if parameter.name in given and parameter.name in DUMPED:
                    parameter.handle_parse_result(ctx, given, [])
            click.echo(_explained(_settled(ctx.params, "stages")), nl=False)
            ctx.exit(0)
        return super().parse_args(ctx, args)


def path_option(*names: str, help: str, required: bool = False) -> Callable[[Function], Function]:
    """An option that takes a path, which need not exist."""
    return click.option(*names, type=click.Path(path_type=Path), required=required, help=help)


class LogPath(click.Path):
    """The path of a file or folder, or an address on a server."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        from semloc_logs.logs.remote import log_path

        return log_path(value)


logs_argument = click.argument("logs", metavar="LOG...", nargs=-1, required=True, type=LogPath())
work_option = path_option("-w", "--work", required=True, help="Workspace folder.")
json_option = click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
overwrite_option = click.option(
    "--overwrite", is_flag=True, help="Do finished work again; replace existing outputs."
)

dry_run_option = click.option(
    "--dry-run",
    is_flag=True,
    help="Print what would be done and about how long it takes; write nothing.",
)
retry_option = click.option(
    "--retry-failed",
    is_flag=True,
    help="Read logs again that failed before, with the same content and settings.",
)


def _set_verbosity(_: click.Context, parameter: click.Parameter, count: int) -> None:
    if count:
        console.verbosity = count if parameter.name == "verbose" else -1


def _set_log_format(_: click.Context, __: click.Parameter, value: str) -> None:
    console.log_format = value


def console_options(function: Function) -> Function:
    """-v, -q and --log-format."""
    eager: dict[str, Any] = {"expose_value": False, "is_eager": True}
    for decorate in (
        click.option(
            "-q",
            "--quiet",
            count=True,
            callback=_set_verbosity,
            help="No notes and no progress; warnings and errors only.",
            **eager,
        ),
        click.option(
            "-v",
            "--verbose",
            count=True,
            callback=_set_verbosity,
            help="All notes, and the traceback of an unexpected error.",
            **eager,
        ),
        click.option(
            "--log-format",
            type=click.Choice(["text", "json"]),
            default="text",
            callback=_set_log_format,
            help="Form of what goes to stderr.",
            **eager,
        ),
    ):
        function = decorate(function)
    return function


def pairs(_: click.Context, __: click.Parameter, values: tuple[str, ...]) -> dict[str, str]:
    """Callback of options NAME=VALUE that may be repeated."""
    out = {}
    for value in values:
        key, equals, rest = value.partition("=")
        if not equals or not key or not rest:
            raise click.BadParameter(f"{value!r} is not of the form NAME=VALUE")
        out[key] = rest
    return out


def _topics(
    ctx: click.Context, parameter: click.Parameter, values: tuple[str, ...]
) -> dict[str, str]:
    """Topics by role. UsageError for an unknown role."""
    chosen = pairs(ctx, parameter, values)
    for role in chosen:
        check_role(role)
    return chosen


def check_role(role: str) -> None:
    """UsageError unless a topic can have this role."""
    from semloc_logs.errors import did_you_mean
    from semloc_logs.logs.role_types import ROLES

    if role not in ROLES:
        raise click.UsageError(
            f"The role '{role}' is unknown; the roles are {', '.join(ROLES)}."
            f"{did_you_mean(role, ROLES)}"
        )


topic_option = click.option(
    "--topic",
    "topics",
    metavar="ROLE=TOPIC",
    multiple=True,
    callback=_topics,
    shell_complete=role_names,
    help="Topic that plays a role, such as lidar=/points; repeatable.",
)


Use = Literal["nothing", "tables", "stages"]


def settings_options(
    function: Function, *, use: Use = "nothing", is_resolved: bool = True
) -> Function:
    """--config, --set and --dump-config; the command gets ``settings``, unless not ``is_resolved``
    with lengths filled in from the voxel size.

    A command that uses the ``tables`` of a workspace takes the settings that this keeps; one of the
    ``stages``, which write them, may have --overwrite to change them.
    """

    @click.option("--config", type=click.Path(path_type=Path), help="YAML file of settings.")
    @click.option(
        "--set",
        "assignments",
        metavar="KEY.PATH=VALUE",
        multiple=True,
        callback=pairs,
        shell_complete=setting_keys,
        help="One setting, such as fusion.voxel_size=0.3 (m); repeatable.",
    )
    @click.option("--dump-config", is_flag=True, help="Print all settings, explained, and exit.")
    @functools.wraps(function)
    def with_settings(*args: Any, dump_config: bool, **options: Any) -> Any:
        settings = _settled(options, use)
        given = settings.resolved() if is_resolved else settings
        rest = {
            k: v for k, v in options.items() if k not in {"config", "assignments", "method", *FLAGS}
        }
        return function(*args, settings=given, **rest)

    return with_settings


def _settings(options: Mapping[str, Any]) -> Settings:
    from semloc_logs.settings import load

    assignments = dict(options.get("assignments") or {})
    given = {key: options[flag] for flag, key in FLAGS.items() if options.get(flag) is not None}
    # the values of --set are YAML, in which a path may mean something else
    assignments |= {
        key: json.dumps(str(value), ensure_ascii=False) if isinstance(value, Path) else str(value)
        for key, value in given.items()
    }
    if options.get("seg_model") is not None:
        assignments.setdefault("labels.source", "onnx")
    return load(options.get("config"), assignments, os.environ, options.get("method"))


def _settled(options: Mapping[str, Any], use: Use) -> Settings:
    """The settings of a command: in a workspace its own, too."""
    given = _settings(options)
    if use == "nothing" or options.get("work") is None:
        return given
    from semloc_logs.stages.state import settle
    from semloc_logs.workspace import Workspace

    writes = use == "stages"
    overwrite = writes and bool(options.get("overwrite"))
    return settle(Workspace(Path(options["work"])), given, writes=writes, overwrite=overwrite)


def _explained(settings: Settings) -> str:
    """YAML that --config reads back, each line with its meaning."""
    lines = []
    for section, values in settings:
        document = (type(values).__doc__ or "").strip().rstrip(".")
        lines.append(f"{section}:  # {document}" if document else f"{section}:")
        for name, value in values.model_dump(mode="json").items():
            meaning = type(values).model_fields[name].description
            lines.append(f"  {name}: {_yaml_value(value)}" + (f"  # {meaning}" if meaning else ""))
    return "\n".join(lines) + "\n"


def _yaml_value(value: object) -> str:
    import yaml

    return (
        str(yaml.safe_dump(value, default_flow_style=True, width=1000))
        .removesuffix("...\n")
        .strip()
    )


def method_option(function: Function) -> Function:
    """--method, a settings file of the package that --config and --set change."""
    return click.option(
        "--method",
        type=click.Choice(["paper"]),
        help="Settings of a method: paper is the paper's, as written.",
    )(function)


def given_settings_options(function: Function) -> Function:
    """The same with the settings as they are given."""
    return settings_options(function, is_resolved=False)


def tables_settings_options(function: Function) -> Function:
    """The same of a command that reads the tables of a workspace."""
    return settings_options(function, use="tables")


def label_options(function: Function) -> Function:
    """--seg-model and --seg-spec."""
    for decorate in (
        click.option(
            "--seg-spec",
            type=click.Path(path_type=Path),
            metavar="SPEC",
            help="YAML file: what the model takes and gives.",
        ),
        click.option(
            "--seg-model",
            type=click.Path(path_type=Path),
            metavar="MODEL",
            help="ONNX model that labels points by the camera pictures.",
        ),
    ):
        function = decorate(function)
    return function


def query_options(function: Function) -> Function:
    """Which queries are made."""
    for decorate in (
        click.option(
            "--query-every",
            type=float,
            metavar="M",
            help="A query after so much road (m), and after every turn of 20 degrees: fewer are"
            " quicker, more find more.  "
            "[default: 2 at 0.30 m voxels, in proportion at others]",
        ),
        click.option(
            "--query-length",
            type=float,
            metavar="M",
            help="A query is fused from all keyframes of so much road (m) around it, instead of"
            " --query-frames: for cameras, "
            "which see little at once, and for places that look alike.",
        ),
        click.option(
            "--query-frames",
            type=int,
            metavar="N",
            help="A query is fused from so many keyframes around it; 1 makes single-frame"
            " queries, as for logs without poses.  "
            "[default: 5]",
        ),
    ):
        function = decorate(function)
    return function


@dataclass(frozen=True, slots=True)
class PoseChoice:
    """Values of --poses, --pose-times and --pose-frame."""

    files: tuple[str, ...]
    times: tuple[str, ...]
    frame: str

    def by_session(self, sessions: Iterable[str]) -> dict[str, TrajectoryFile]:
        """Files of poses; UsageError when it is not clear which session a file belongs to."""
        from semloc_logs.logs.poses.trajectory_file import TrajectoryFile

        names = list(sessions)
        files = _by_session("--poses", names, self.files)
        times = _by_session("--pose-times", names, self.times)
        without = [name for name in times if name not in files]
        if without or (self.frame and not files):
            raise click.UsageError(
                f"{'--pose-times' if without else '--pose-frame'} needs --poses FILE, too."
            )
        return {
            name: TrajectoryFile(file, times.get(name), self.frame) for name, file in files.items()
        }


def _by_session(option: str, names: list[str], values: Iterable[str]) -> dict[str, Path]:
    out: dict[str, Path] = {}
    for value in values:
        name, equals, rest = value.partition("=")
        if not (equals and name in names):
            name = names[0]
            rest = value
            if len(names) > 1:
                raise click.UsageError(
                    f"{option} {value}: say which session it belongs to with SESSION=FILE"
                    f" ({', '.join(names)})."
                )
        if name in out:
            raise click.UsageError(f"{option} is given twice for session '{name}'.")
        out[name] = Path(rest)
    return out


def pose_options(function: Function) -> Function:
    """Poses from elsewhere than a stream of the log; the command gets ``poses``, a PoseChoice, and
    the setting of --odometry.
    """

    @click.option(
        "--odometry",
        type=click.Choice(["none", "lidar"]),
        help="lidar: poses from LIDAR odometry instead of the log's own (needs the extra"
        " 'odometry').",
    )
    @click.option(
        "--poses",
        "pose_files",
        metavar="[SESSION=]FILE",
        multiple=True,
        help="Trajectory (TUM or KITTI) instead of the log's own poses; SESSION= for each of"
        " several logs.",
    )
    @click.option(
        "--pose-times",
        metavar="[SESSION=]FILE",
        multiple=True,
        help="Times of KITTI poses, one in seconds a line.",
    )
    @click.option(
        "--pose-frame",
        metavar="FRAME",
        default="",
        help="Frame that the poses of --poses are of; default: the base frame.",
    )
    @functools.wraps(function)
    def with_poses(
        *args: Any,
        pose_files: tuple[str, ...],
        pose_times: tuple[str, ...],
        pose_frame: str,
        **options: Any,
    ) -> Any:
        return function(*args, poses=PoseChoice(pose_files, pose_times, pose_frame), **options)

    return with_poses


stamps_option = click.option(
    "--stamps",
    type=click.Choice(["auto", "header", "log"]),
    help="Times of messages: their header stamps, or when they were recorded; auto: header stamps"
    " unless all of a topic are 0.  [default: auto]",
)


def reading_options(function: Function) -> Function:
    """What is read of the logs, and how: topics, stamps, poses and labels."""
    return topic_option(stamps_option(pose_options(label_options(function))))


@dataclass(frozen=True, slots=True)
class EngineChoice:
    """Values of --engine, --jobs, --scheduler and --max-memory."""

    name: str | None
    jobs: int | None
    scheduler: str | None = None
    max_memory: int | None = None

    @contextmanager
    def open(self, tasks: int) -> Iterator[Engine]:
        """The engine for so many sessions or scenes; its workers end with the block, at once if the
        block fails.
        """
        from semloc_logs.engines import make_engine

        name = self._chosen(tasks)
        engine = make_engine(name, self.jobs, scheduler=self.scheduler, max_memory=self.max_memory)
        if name != "serial" and self.max_memory and engine.jobs < (self.jobs or 0):
            console.note(f"--max-memory is enough for {engine.jobs} of {self.jobs} workers.")
        try:
            yield engine
        except BaseException:
            engine.stop()
            raise
        engine.close()

    def _chosen(self, tasks: int) -> str:
        from semloc_logs.engines.processes import cores

        if self.name is not None:
            return self.name
        if self.scheduler is not None:
            return "dask"
        is_parallel = (self.jobs or cores()) > 1 and (tasks > 1 or self.jobs is not None)
        return "processes" if is_parallel else "serial"


class Bytes(click.ParamType):  # type: ignore[type-arg]  # generic from click 8.4 on
    """A number of bytes, such as 8GB or 500M; a number alone is of gigabytes."""

    name = "SIZE"

    def convert(
        self, value: Any, parameter: click.Parameter | None, context: click.Context | None
    ) -> int:
        if isinstance(value, int):
            return value
        text = str(value).strip().upper().removesuffix("B").removesuffix("I")
        unit = {"K": 1e3, "M": 1e6, "G": 1e9, "T": 1e12}.get(text[-1:], 0.0)
        try:
            size = float(text[:-1]) * unit if unit else float(text) * 1e9
        except ValueError:
            size = 0.0
        if not LEAST_MEMORY <= size < 1e18:
            self.fail(f"{value!r} is not a size of at least 500 MB, such as 8GB.")
        return int(size)


def engine_options(function: Function) -> Function:
    """Where work runs; the command gets ``engine``, an EngineChoice."""

    @click.option(
        "--engine",
        "engine_name",
        type=click.Choice(["serial", "processes", "dask"]),
        help="Where work runs; default: processes for several sessions on several cores. dask"
        " needs the extra 'dask'.",
    )
    @click.option(
        "--jobs",
        type=click.IntRange(1, 1024),
        metavar="N",
        help="Worker processes; default: the cores of this machine, as far as its memory is enough"
        " for.",
    )
    @click.option(
        "--scheduler",
        metavar="ADDRESS",
        help="Use the workers of this Dask scheduler, such as tcp://head:8786; default: workers on"
        " this machine.",
    )
    @click.option(
        "--max-memory",
        type=Bytes(),
        help="Memory of all workers of this machine together, such as 8GB: fewer workers, and a"
        " task that needs more than its share ends with a sentence.",
    )
    @functools.wraps(function)
    def with_engine(
        *args: Any,
        engine_name: str | None,
        jobs: int | None,
        scheduler: str | None,
        max_memory: int | None,
        **options: Any,
    ) -> Any:
        engine = EngineChoice(engine_name, jobs, scheduler, max_memory)
        return function(*args, engine=engine, **options)

    return with_engine


def stage_options(function: Function) -> Function:
    """Options of every stage: --overwrite, --json, the engine, settings and the console."""
    for decorate in (
        console_options,
        functools.partial(settings_options, use="stages"),
        engine_options,
        json_option,
        overwrite_option,
    ):
        function = decorate(function)
    return function
