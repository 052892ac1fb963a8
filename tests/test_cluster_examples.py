"""The scripts of ``examples/cluster`` run as the schedulers run them: stand-ins for ``sbatch``,
``kubectl`` and ``hq`` set the variables that the real ones set, and run the command lines.
"""

from __future__ import annotations

import csv
import hashlib
import os
import re
import shutil
import stat
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pyarrow.parquet as pq
import pytest
import yaml

EXAMPLES = Path(__file__).resolve().parents[1] / "examples/cluster"
PROGRAM = [sys.executable, "-c", "from semloc_logs.cli.main import main; main()"]
QUICK = {
    "SEMLOC_FUSION__VOXEL_SIZE": "0.5",
    "SEMLOC_QUERY__EVERY": "20",
    "SEMLOC_CLOSURES__MIN_VOTES": "0",  # the drives hardly meet
}

SEMLOC = """#!{python}
import sys
from semloc_logs.cli.main import main
with open({record!r}, "a") as file:
    file.write(" ".join(sys.argv[1:]) + "\\n")
main()
"""
SBATCH = """#!{python}
# runs the array at once, one job after the other, and prints the number of the job
import os, re, subprocess, sys
arguments = sys.argv[1:]
first, last = map(int, arguments[arguments.index("--array") + 1].split("-"))
script = arguments[-1]
options = dict(re.findall(r"^#SBATCH --([a-z-]+)=?(.*)$", open(script).read(), re.M))
variables = {{"SLURM_ARRAY_JOB_ID": "7", "SLURM_ARRAY_TASK_COUNT": str(last - first + 1),
    "SLURM_ARRAY_TASK_MIN": str(first), "SLURM_ARRAY_TASK_MAX": str(last),
    "SLURM_CPUS_PER_TASK": options["cpus-per-task"]}}
for index in range(first, last + 1):
    numbers = {{"SLURM_ARRAY_TASK_ID": str(index), "SLURM_JOB_ID": str(8 + index)}}
    done = subprocess.run(["bash", script], env={{**os.environ, **variables, **numbers}},
        stdout=subprocess.DEVNULL)
    with open({record!r}, "a") as file:
        file.write(f"exit {{done.returncode}}\\n")
print(7)
"""
KUBECTL = """#!{python}
# runs the pods of an indexed Job, one after the other; /data is the folder of the test
import os, re, subprocess, sys, yaml
if sys.argv[1] == "wait":
    sys.exit(0)
spec = yaml.safe_load(sys.stdin)["spec"]
container = spec["template"]["spec"]["containers"][0]
assert container["volumeMounts"][0]["mountPath"] == "/data"
for index in range({pods}):
    env = {{e["name"]: e["value"] for e in container["env"]}} | {{"JOBS": "{pods}"}}
    env["JOB_COMPLETION_INDEX"] = str(index)
    words = [re.sub(r"[$][(]([A-Z_]+)[)]", lambda m: env[m[1]], str(word))
        for word in (*container["command"], *container["args"])]
    words = [word.replace("/data", {data!r}, 1) if word.startswith("/data") else word
        for word in words]
    done = subprocess.run(words, env={{**os.environ, **env}}, stdout=subprocess.DEVNULL)
    with open({record!r}, "a") as file:
        file.write(f"exit {{done.returncode}}\\n")
"""
HQ = """#!{python}
import os, subprocess, sys
arguments = sys.argv[1:]
assert arguments[0] == "submit" and "--wait" in arguments
first, last = map(int, arguments[arguments.index("--array") + 1].split("-"))
words = arguments[arguments.index("--") + 1:]
for index in range(first, last + 1):
    env = {{**os.environ, "HQ_TASK_ID": str(index), "HQ_JOB_ID": "1"}}
    done = subprocess.run(words, env=env, stdout=subprocess.DEVNULL)
    with open({record!r}, "a") as file:
        file.write(f"exit {{done.returncode}}\\n")
"""
PODS = 2


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two drives, a log that is none, and a manifest of all three."""
    folder = tmp_path_factory.mktemp("logs")
    words = ["simulate", "-o", str(folder), "--length", "50", "--rate", "1", "--drift", "0"]
    subprocess.run([*PROGRAM, *words], check=True, capture_output=True)
    (folder / "bad.mcap").write_bytes(b"not a log")
    with (folder / "drives.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["name", "logs"])
        writer.writerows([[f"day_{k}", f"session_{k}.mcap"] for k in range(2)])
        writer.writerow(["bad", "bad.mcap"])
    return folder


def tables(work: Path) -> dict[str, str]:
    """Digests of all tables of a workspace."""
    return {
        str(path.relative_to(work)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(work.rglob("*.parquet"))
    }


@pytest.fixture(scope="module")
def expected(logs: Path) -> Iterator[dict[str, str]]:
    """The tables of `semloc run`."""
    work = logs / "expected"
    words = ["run", "-w", str(work), "--manifest", str(logs / "drives.csv")]
    done = subprocess.run(
        [*PROGRAM, *words], env={**os.environ, **QUICK}, capture_output=True, text=True
    )
    assert done.returncode == 3, done.stderr  # the bad log is named
    alignments = list(work.glob("alignments/*/*/*.parquet"))
    assert len(alignments) == 3
    assert sum(pq.read_metadata(path).num_rows for path in alignments) > 0
    yield tables(work)
    shutil.rmtree(work)


def programs(folder: Path, **names: str) -> dict[str, str]:
    """The environment in which the stand-ins are found."""
    folder.mkdir()
    record = str(folder.parent / "record")
    data = str(folder.parent / "data")
    for name, text in {"semloc": SEMLOC, **names}.items():
        path = folder / name
        path.write_text(text.format(python=sys.executable, record=record, data=data, pods=PODS))
        path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return {**os.environ, **QUICK, "PATH": f"{folder}:{os.environ['PATH']}"}


def night(folder: str, *arguments: object, environment: dict[str, str]) -> None:
    script = EXAMPLES / folder / "night.sh"
    words = ["bash", str(script), *map(str, arguments)]
    done = subprocess.run(words, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def exits(tmp_path: Path) -> list[str]:
    return re.findall(r"^exit (\d+)$", (tmp_path / "record").read_text(), re.MULTILINE)


@pytest.mark.timeout(1800)  # dozens of programs that import much
def test_slurm_arrays(logs: Path, expected: dict[str, str], tmp_path: Path) -> None:
    environment = programs(tmp_path / "bin", sbatch=SBATCH) | {"JOBS": "2"}
    work = tmp_path / "work"
    night("slurm", logs / "drives.csv", work, environment=environment)
    assert tables(work) == expected
    assert sorted(exits(tmp_path)) == ["0"] * 6 + ["1"]  # 2 + 2 + 2 + 1 jobs; one has the bad log


@pytest.mark.timeout(1800)  # dozens of programs that import much
def test_kubernetes_jobs(logs: Path, expected: dict[str, str], tmp_path: Path) -> None:
    environment = programs(tmp_path / "bin", kubectl=KUBECTL)
    data = tmp_path / "data"
    data.mkdir()
    for path in logs.glob("*.*"):
        (data / path.name).symlink_to(path)
    night("kubernetes", environment=environment)
    assert tables(data / "work") == expected
    assert sorted(exits(tmp_path)) == ["0"] * 7 + ["1"]


def test_the_failure_policy_knows_our_exit_codes() -> None:
    text = (EXAMPLES / "kubernetes/stage.yaml").read_text().replace("STAGE", "fuse")
    spec = yaml.safe_load(text)["spec"]
    assert spec["completionMode"] == "Indexed"
    rules = {
        code: rule["action"]
        for rule in spec["podFailurePolicy"]["rules"]
        for code in rule.get("onExitCodes", {}).get("values", [])
    }
    assert rules == {2: "FailJob", 1: "FailIndex"}
    container = spec["template"]["spec"]["containers"][0]
    jobs = {e["name"]: e["value"] for e in container["env"]}["JOBS"]
    assert int(jobs) == spec["completions"]
    assert spec["template"]["spec"]["restartPolicy"] == "Never"  # the policy needs it


@pytest.mark.timeout(1800)  # dozens of programs that import much
def test_hyperqueue_arrays(logs: Path, expected: dict[str, str], tmp_path: Path) -> None:
    environment = programs(tmp_path / "bin", hq=HQ)
    work = tmp_path / "work"
    night("hyperqueue", logs / "drives.csv", work, environment=environment)
    assert tables(work) == expected
    # three logs, two sessions, three pairs, one decision
    assert sorted(exits(tmp_path)) == ["0"] * 8 + ["1"]


def test_the_image_gets_what_the_package_is_built_from() -> None:
    text = (EXAMPLES / "Dockerfile").read_text()
    lines = re.findall(r"^COPY (.*)$", text, re.MULTILINE)
    copied = {word for line in lines for word in line.split()[:-1]}
    root = EXAMPLES.parents[1]
    assert {"pyproject.toml", "README.md", "LICENSE", "semloc_logs", "cli", "schemas"} <= copied
    assert all((root / name).exists() for name in copied)
