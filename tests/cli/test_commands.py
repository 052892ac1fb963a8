"""What each command hands to the pipeline and prints of its answer; the stages themselves are
stand-ins or hand-made files.
"""

import importlib
import inspect
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from click.testing import CliRunner, Result
from mcap.writer import Writer

from semloc_logs.benchmarks.named import Outcome
from semloc_logs.cli.main import program
from semloc_logs.logs.annotation.annotate import AnnotateReport
from semloc_logs.stages.annotate import Annotation, AnnotationMode
from semloc_logs.stages.inputs import Redo
from semloc_logs.stages.pair_search import Selection
from semloc_logs.stages.report import Report
from semloc_logs.tables import contracts
from semloc_logs.tables.table import write_json, write_table
from semloc_logs.training.network_training import TrainingRun
from semloc_logs.training.runs import Packed
from semloc_logs.voxels.store import pose_columns
from semloc_logs.workspace import Workspace


def semloc(*args: object, **options: Any) -> Result:
    return CliRunner().invoke(program, [str(a) for a in args], prog_name="semloc", **options)


def _write_closures(work: Workspace, count: int = 2) -> None:
    columns: dict[str, Any] = {
        "query_session": ["tuesday"] * count,
        "target_session": ["monday"] * count,
        "query_stamp_ns": [k * 10**9 for k in range(count)],
        "target_stamp_ns": [k * 10**9 for k in range(count)],
        **pose_columns(np.tile(np.eye(4), (count, 1, 1))),
        "covariance": [np.eye(6).ravel().tolist()] * count,
        "overlap": [0.625] * count,
        "probability": [0.9987] * count,
        "inliers": [1] * count,
        "words": [1] * count,
    }
    write_table(work.closures, contracts.table("closures", columns), {"schema_version": 1})


@pytest.fixture
def called(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> Callable[[str, Report], dict[str, Any]]:
    """Puts a stand-in for a stage; the dict holds the arguments of its call."""

    def put(stage: str, answer: Any) -> dict[str, Any]:
        seen: dict[str, Any] = {}

        def stand_in(*args: Any, **options: Any) -> Any:
            seen.update(signature.bind(*args, **options).arguments)
            return answer

        module = importlib.import_module(f"semloc_logs.stages.{stage}")
        signature = inspect.signature(getattr(module, stage))
        monkeypatch.setattr(module, stage, stand_in)
        # no stage has made sessions that a table could show
        monkeypatch.setattr("semloc_logs.stages.stored_sessions.list_sessions", lambda work: [])
        return seen

    _write_closures(Workspace(tmp_path / "work"))
    return put


# -- names of sessions


@pytest.mark.parametrize(
    ("log", "shown"),
    [("...mcap", "'..'"), ("..mcap", "'.'"), (".mcap", "'.mcap'"), ("a\nb.mcap", "'a\\nb'")],
)
@pytest.mark.parametrize("command", ["fuse", "run"])
def test_a_log_whose_name_leads_elsewhere_is_refused(
    tmp_path: Path, command: str, log: str, shown: str
) -> None:
    (tmp_path / log).write_bytes(b"\x89MCAP0\r\n")
    work = tmp_path / "work" / "here"
    done = semloc(command, tmp_path / log, "-w", work)
    assert done.exit_code == 2
    assert f"A session cannot be called {shown}" in done.stderr
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted([log])


# -- settings


def _dumped(*args: object, **options: Any) -> Any:
    done = semloc("run", "--dump-config", *args, **options)
    assert done.exit_code == 0, done.stderr
    return yaml.safe_load(done.stdout)


def test_settings_come_from_defaults_then_file_then_environment_then_flags(tmp_path: Path) -> None:
    file = tmp_path / "s.yaml"
    file.write_text("fusion: {voxel_size: 0.4, hit: 0.7}\nquery: {frames: 2, length: 11}\n")
    environment = {"SEMLOC_FUSION__VOXEL_SIZE": "0.5", "SEMLOC_QUERY__FRAMES": "3"}
    assert _dumped()["fusion"]["voxel_size"] == 0.3
    assert _dumped("--config", file)["fusion"]["voxel_size"] == 0.4
    assert _dumped("--config", file, env=environment)["fusion"]["voxel_size"] == 0.5
    all_of_it = _dumped(
        "--config", file, "--set", "fusion.voxel_size=0.6", "--query-frames", 4, env=environment
    )
    assert all_of_it["fusion"]["voxel_size"] == 0.6
    assert all_of_it["fusion"]["hit"] == 0.7
    assert all_of_it["query"]["frames"] == 4
    assert all_of_it["query"]["length"] == 11


@pytest.mark.parametrize(
    "name", ["model #2.onnx", "a: b.onnx", "[1].onnx", "12", "größe 😀.onnx", "it's \\ so.onnx"]
)
def test_a_path_is_taken_as_it_is(name: str) -> None:
    content = yaml.safe_load(semloc("run", "--dump-config", "--seg-model", name).stdout)
    assert content["labels"]["model"] == name
    assert content["labels"]["source"] == "onnx"


def test_what_dump_config_prints_is_read_back(tmp_path: Path) -> None:
    first = semloc(
        "run",
        "--dump-config",
        "--set",
        "closures.min_probability=0.5",
        "--set",
        "fusion.clamp=[-1, 2]",
    ).stdout
    (tmp_path / "s.yaml").write_text(first)
    assert semloc("run", "--dump-config", "--config", tmp_path / "s.yaml").stdout == first


@pytest.mark.parametrize(
    ("args", "environment", "names"),
    [
        (["--set", "fusion.voxel_sizee=0.3"], {}, "fusion.voxel_sizee"),
        (["--set", "fussion.voxel_size=0.3"], {}, "fussion"),
        (["--set", "fusion.voxel_size=small"], {}, "fusion.voxel_size"),
        ([], {"SEMLOC_QUERY__FRAME": "3"}, "query.frame"),
        (["--query-every", "-1"], {}, "query.every"),
        (["--config", "/no/such/file.yaml"], {}, "/no/such/file.yaml"),
    ],
)
def test_wrong_settings_are_named_and_2(
    tmp_path: Path, args: list[str], environment: dict[str, str], names: str
) -> None:
    done = semloc("run", "a.mcap", "-w", tmp_path / "w", *args, env=environment)
    assert done.exit_code == 2
    assert names in done.stderr
    assert not (tmp_path / "w").exists()


@pytest.mark.parametrize("value", ["fusion.voxel_size", "=1", "fusion.voxel_size="])
def test_set_needs_a_name_and_a_value(value: str) -> None:
    assert semloc("run", "a.mcap", "-w", "w", "--set", value).exit_code == 2


# -- run, fuse, describe, close


def test_run_makes_each_log_a_session(called: Any, tmp_path: Path) -> None:
    seen = called("run", Report(done=["fuse monday"], seconds={"fuse": 1.25}, closures=2))
    (tmp_path / "tuesday").mkdir()
    logs = (tmp_path / "monday.mcap", tmp_path / "tuesday")
    done = semloc(
        "run",
        *logs,
        "-w",
        tmp_path / "work",
        "--topic",
        "lidar=/points",
        "--query-frames",
        3,
        "--annotate",
        "copy",
        "--overwrite",
    )
    assert done.exit_code == 0, done.stderr
    assert [(s.name, s.logs, dict(s.topics)) for s in seen["sessions"]] == [
        ("monday", (logs[0],), {"lidar": "/points"}),
        ("tuesday", (logs[1],), {"lidar": "/points"}),
    ]
    assert seen["settings"].query.frames == 3
    assert seen["settings"].fusion.max_range == 50.0  # resolved
    assert (seen["annotation"], seen["redo"]) == ("copy", Redo.EVERYTHING)
    assert "0.9987" in done.stdout
    assert f"2 loop closures in {tmp_path / 'work/closures.parquet'}" in done.stdout
    assert "fuse 1.2 s" in done.stdout


def test_run_prints_its_report_as_json(called: Any, tmp_path: Path) -> None:
    called(
        "run",
        Report(
            done=["fuse a"],
            kept=["describe a"],
            skipped=["a: lost."],
            failed=["b is not a log."],
            seconds={"fuse": 1.5},
            closures=7,
        ),
    )
    done = semloc("run", "a.mcap", "-w", tmp_path / "work", "--json")
    assert done.exit_code == 3
    assert json.loads(done.stdout) == {
        "work": str(tmp_path / "work"),
        "done": ["fuse a"],
        "kept": ["describe a"],
        "skipped": ["a: lost."],
        "failed": ["b is not a log."],
        "seconds": {"fuse": 1.5},
        "closures": 7,
    }
    assert done.stderr.splitlines() == ["Warning: a: lost.", "Warning: b is not a log."]


def test_two_logs_of_one_name_are_refused(tmp_path: Path) -> None:
    done = semloc("run", tmp_path / "x/a.mcap", tmp_path / "y/a.bag", "-w", tmp_path / "w")
    assert done.exit_code == 2
    assert "session 'a'" in done.stderr


def test_closures_are_shown_by_pairs_of_sessions(called: Any, tmp_path: Path) -> None:
    work = Workspace(tmp_path / "work")
    _write_closures(work, 50)
    write_json(work.session("wednesday").session_json, {})
    called("run", Report(closures=50))
    done = semloc("run", "a.mcap", "-w", tmp_path / "work")
    row = next(line for line in done.stdout.splitlines() if line.split()[:1] == ["tuesday"])
    assert row.split() == ["tuesday", "monday", "50", "49", "0.62", "0.9987"]
    assert "Without closures: wednesday" in done.stdout
    assert "50 loop closures in" in done.stdout
    assert max(len(line.rstrip()) for line in done.stdout.splitlines() if "monday" in line) <= 80


def test_fuse_makes_all_logs_one_session(called: Any, tmp_path: Path) -> None:
    seen = called("fuse", Report(done=["drive"]))
    assert (
        semloc(
            "fuse", "a_0.mcap", "a_1.mcap", "-w", tmp_path / "work", "--session", "drive"
        ).exit_code
        == 0
    )
    (session,) = seen["sessions"]
    assert session.name == "drive"
    assert [str(log) for log in session.logs] == ["a_0.mcap", "a_1.mcap"]
    semloc("fuse", "a_0.mcap", "a_1.mcap", "-w", tmp_path / "work")
    assert [s.name for s in seen["sessions"]] == ["a_0"]


@pytest.mark.parametrize("name", ["../x", "a/b", "", ".hidden"])
def test_a_session_needs_a_name_that_is_a_folder(name: str, tmp_path: Path) -> None:
    done = semloc("fuse", "a.mcap", "-w", tmp_path / "w", f"--session={name}")
    assert (done.exit_code == 2) if name else (done.exit_code == 1)  # an empty name is none
    assert not (tmp_path / "x").exists()


def test_skipped_input_is_3(called: Any, tmp_path: Path) -> None:
    called(
        "fuse",
        Report(
            done=["a"], skipped=["a.mcap is cut off at byte 100.", "a.mcap is cut off at byte 100."]
        ),
    )
    done = semloc("fuse", "a.mcap", "-w", tmp_path / "work")
    assert done.exit_code == 3
    assert done.stderr == "Warning: a.mcap is cut off at byte 100.\n"


def test_describe_and_close_take_sessions(called: Any, tmp_path: Path) -> None:
    described = called("describe", Report(done=["a"]))
    closed = called("close", Report(done=["closures"], closures=2))
    assert semloc("describe", "a", "b", "-w", tmp_path / "work").exit_code == 0
    assert described["names"] == ("a", "b")
    done = semloc(
        "close",
        "-w",
        tmp_path / "work",
        "--query",
        "a",
        "--query",
        "b",
        "--target",
        "c",
        "--no-self",
        "--query-length",
        12.5,
        "--json",
    )
    assert done.exit_code == 0
    assert closed["selection"] == Selection(("a", "b"), ("c",), self_closures=False)
    assert closed["settings"].query.length == 12.5
    assert len(json.loads(done.stdout)["closures"]) == 2


def test_a_workspace_without_sessions_is_1(tmp_path: Path) -> None:
    for command in (["describe"], ["close"], ["export", "--format", "tum"]):
        done = semloc(*command, "-w", tmp_path / "w")
        assert done.exit_code == 1
        assert "holds no sessions" in done.stderr


# -- annotate


@pytest.mark.parametrize(
    "outputs",
    [
        [],
        ["-o", "x.mcap", "--in-place"],
        ["--in-place", "--sidecar", "x.mcap"],
        ["-o", "x", "--sidecar", "y"],
    ],
)
def test_annotate_needs_exactly_one_output(outputs: list[str]) -> None:
    done = semloc("annotate", "a.mcap", "-w", "w", *outputs)
    assert done.exit_code == 2
    assert "exactly one" in done.stderr


@pytest.mark.parametrize(
    ("outputs", "mode", "output"),
    [
        (["-o", "x.mcap"], "copy", Path("x.mcap")),
        (["--in-place"], "in-place", None),
        (["--sidecar", "y.mcap"], "sidecar", Path("y.mcap")),
    ],
)
def test_annotate_hands_on_what_was_asked(
    called: Any, outputs: list[str], mode: str, output: Path | None
) -> None:
    seen = called("annotate", AnnotateReport(Path("x.mcap"), "run", "ros2", 3, 9, 1234, True))
    done = semloc("annotate", "a.mcap", "-w", "w", *outputs, "--session", "other", "--json")
    assert done.exit_code == 0, done.stderr
    assert seen["annotation"] == Annotation(AnnotationMode(mode), output, overwrite=False)
    assert seen["session"] == "other"
    assert json.loads(done.stdout)["closures"] == 3


# -- inspect


def _log(path: Path, messages: int = 3) -> Path:
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("Note", "jsonschema", b'{"type": "object"}')
        channel = writer.register_channel("/note", "json", schema)
        for k in range(messages):
            writer.add_message(channel, k * 10**9, b"{}", k * 10**9)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def test_inspect_prints_an_array(tmp_path: Path) -> None:
    a = _log(tmp_path / "a.mcap")
    b = _log(tmp_path / "b.mcap", 5)
    (one,) = json.loads(semloc("inspect", a, "--json").stdout)
    assert one["path"] == str(a)
    assert one["format"] == "mcap"
    assert one["streams"] == [
        {"topic": "/note", "type": "Note", "role": None, "count": 3, "rate_hz": 1.0}
    ]
    assert one["problems"]
    assert one["verdict"].startswith("not ready: ")
    both = json.loads(semloc("inspect", a, b, "--json").stdout)
    assert [log["streams"][0]["count"] for log in both] == [3, 5]


def test_inspect_for_people(tmp_path: Path) -> None:
    done = semloc("inspect", _log(tmp_path / "a.mcap"))
    assert done.exit_code == 0
    assert "/note (Note, 3)" in done.stdout
    assert "1970-01-01 00:00:00 UTC, 2.0 s" in done.stdout
    assert "not ready: there is neither a LIDAR" in done.stdout
    assert done.stderr == ""


def test_inspect_of_what_is_no_log_is_1(tmp_path: Path) -> None:
    (tmp_path / "empty.bag").touch()
    done = semloc("inspect", tmp_path / "empty.bag")
    assert (done.exit_code, done.stdout) == (1, "")
    assert "is empty" in done.stderr
    done = semloc("inspect", tmp_path / "empty.bag", "--json")
    assert done.exit_code == 1
    assert "is empty" in done.stderr
    (refused,) = json.loads(done.stdout)
    assert refused["streams"] == []
    assert "is empty" in refused["problems"][0]
    assert refused["verdict"].startswith("not ready: ")


def test_inspect_goes_on_after_a_bad_log(tmp_path: Path) -> None:
    (tmp_path / "empty.bag").touch()
    done = semloc("inspect", tmp_path / "empty.bag", _log(tmp_path / "a.mcap"), "--json")
    assert done.exit_code == 3
    logs = json.loads(done.stdout)
    assert [log["path"] for log in logs] == [
        str(tmp_path / "empty.bag"),
        str(tmp_path / "a.mcap"),
    ]
    assert [bool(log["streams"]) for log in logs] == [False, True]
    assert "is empty" in done.stderr


def test_inspect_says_3_when_data_are_lost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lost = {
        "path": "a.mcap",
        "skipped": ["/points: 3 messages cannot be read."],
        "problems": [],
        "streams": [],
    }
    monkeypatch.setattr("semloc_logs.logs.inspection.inspect.inspect_log", lambda *_, **__: lost)
    done = semloc("inspect", "a.mcap", "--json")
    assert done.exit_code == 3
    assert done.stderr == "Warning: a.mcap: /points: 3 messages cannot be read.\n"


def test_inspect_of_metadata_is_of_its_folder(tmp_path: Path) -> None:
    _log(tmp_path / "a.mcap")
    (tmp_path / "metadata.yaml").write_text("rosbag2_bagfile_information: {}")
    done = semloc("inspect", tmp_path / "metadata.yaml", "--json")
    assert done.exit_code == 0, done.stderr
    assert [log["path"] for log in json.loads(done.stdout)] == [str(tmp_path)]


def test_inspect_takes_settings(tmp_path: Path) -> None:
    log = _log(tmp_path / "a.mcap")
    refused = semloc("inspect", log, "--set", "logs.time_offset./none=1")
    assert refused.exit_code == 1
    assert "logs.time_offset names /none" in refused.stderr
    (tmp_path / "c.yaml").write_text("logs: {memory: 1}")
    unknown = semloc("inspect", log, "--config", tmp_path / "c.yaml")
    assert unknown.exit_code == 2
    assert "logs.memory" in unknown.stderr
    (tmp_path / "c.yaml").write_text("logs: {time_offset: {/note: 5}}")
    assert semloc("inspect", log, "--config", tmp_path / "c.yaml").exit_code == 0


def test_inspect_full_reads_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("semloc_logs.logs.inspection.excerpt.WHOLE_BYTES", 0)
    log = _log(tmp_path / "a.mcap")
    quick = semloc("inspect", log)
    assert "--full reads all messages" in quick.stdout
    assert "--full" not in semloc("inspect", log, "--full").stdout


@pytest.mark.parametrize(
    ("args", "code"),
    [
        (["inspect", "{log}"], 0),
        (["fuse", "{log}", "-w", "{work}"], 1),
        (["run", "{log}", "-w", "{work}"], 1),
    ],
)
def test_commands_that_open_a_log_repair_it_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, args: list[str], code: int
) -> None:
    repaired: list[Path] = []

    def recover(path: Path) -> bool:
        repaired.append(path)
        return False

    for module in (
        "semloc_logs.logs.annotation.annotate",
        "semloc_logs.stages.fuse",
        "semloc_logs.stages.annotate",
    ):
        monkeypatch.setattr(f"{module}.recover", recover)
    log = _log(tmp_path / "a.mcap")
    done = semloc(*(a.format(log=log, work=tmp_path / "w") for a in args))
    assert done.exit_code == code
    assert repaired == [log]


# -- simulate, train, vocabulary, benchmark


def test_simulate_refuses_the_impossible(tmp_path: Path) -> None:
    assert semloc("simulate", "-o", tmp_path / "s", "--length", 1).exit_code == 2
    assert semloc("simulate", "-o", tmp_path / "s", "--sensor", "sonar").exit_code == 2
    assert not (tmp_path / "s").exists()


def test_train_holds_two_shards_out_and_prints_scores(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trained: list[tuple[str, int, int]] = []

    def learn(
        variant: str,
        shards: Packed,
        settings: Any,
        run: TrainingRun,
        output: Path,
        note: Any,
    ) -> dict[str, float] | None:
        assert (run.device, run.snapshots) == ("cpu", None)
        if run.deadline < time.monotonic() + 60:
            return None
        trained.append((variant, len(shards.train), settings.training.samples))
        assert run.checkpoint == tmp_path / "w/checkpoint" / f"{variant}.safetensors"
        return {"accuracy": 0.875}

    monkeypatch.setattr(
        "semloc_logs.training.runs.simulated_shards",
        lambda folder, settings, *_: Packed([Path("s")] * settings.training.scenes, []),
    )
    monkeypatch.setattr("semloc_logs.training.runs.learn_descriptor", learn)
    monkeypatch.setattr("semloc_logs.training.runs.use_threads", lambda _: None)
    options = ("--scenes", 5, "--samples", 900, "--engine", "serial", "--device", "cpu")
    done = semloc("train", "-o", tmp_path / "w", *options, "--json")
    assert done.exit_code == 0, done.stderr
    assert trained == [("semantic", 5, 900), ("geometric", 5, 900)]
    assert json.loads(done.stdout)["semantic"]["accuracy"] == 0.875
    assert (
        "0.8750" in semloc("train", "-o", tmp_path / "w", "--variant", "semantic", *options).stdout
    )
    unfinished = semloc("train", "-o", tmp_path / "w", *options, "--minutes", 0.5)
    assert unfinished.exit_code == 3
    assert "goes on from there" in unfinished.stderr


def test_vocabularies_of_both_variants_have_the_shipped_weights_and_shards(tmp_path: Path) -> None:
    both = ("vocabulary", "--variant", "both", "-o", tmp_path / "v", "--shards", tmp_path)
    assert semloc(*both, "--set", "descriptor.weights=w.safetensors").exit_code == 2
    assert semloc(*both, "-w", tmp_path).exit_code == 2
    result = semloc(*both)
    assert result.exit_code == 2
    assert "no shards of packed pairs" in result.output + result.stderr
    assert not (tmp_path / "v").exists()


def test_vocabulary_needs_a_variant(tmp_path: Path) -> None:
    assert semloc("vocabulary", "-o", tmp_path / "v.safetensors").exit_code == 2


def test_benchmark_prints_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    figures: dict[str, dict[str, float | str]] = {
        "messages": {"ours": 400.0, "unit": "MB/s", "peer": 200.0},
        "clouds": {"ours": 2.5, "unit": "ms"},
    }
    monkeypatch.setattr(
        "semloc_logs.benchmarks.named.BENCHMARKS", {"reading": lambda _: Outcome(figures)}
    )
    assert json.loads(semloc("benchmark", "reading", "--json").stdout) == figures
    assert "200" in semloc("benchmark", "reading").stdout
    done = semloc("benchmark", "nothing")
    assert done.exit_code == 2
    assert "reading" in done.stderr


def test_all_logs_failing_is_1(tmp_path: Path) -> None:
    done = semloc("run", tmp_path / "no.mcap", "-w", tmp_path / "w")
    assert done.exit_code == 1
    assert "no.mcap" in done.stderr


def test_every_point_format_of_the_library_is_offered() -> None:
    from semloc_logs.cli.commands import export
    from semloc_logs.exports import FORMATS, POINT_FORMATS

    form = next(p for p in export.command.params if p.name == "form")

    assert export.POINTS == POINT_FORMATS
    assert set(form.type.choices) == set(FORMATS)
