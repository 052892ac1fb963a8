"""Figures of speed on data made here and now, each beside what else does the same in the same run.

Every benchmark returns ``{figure: {"ours": number, "unit": ..., PEER: number, ...}}``; a peer that
is not installed is left out.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from semloc_logs.settings import Resolved

if TYPE_CHECKING:
    from semloc_logs.logs.annotation.annotate import ClosureRecord

Figures = dict[str, dict[str, float | str]]
REPEATS = 5
CLOSURES = 100  # in the annotated log


def _seconds(action: Callable[[], Any], repeats: int = REPEATS) -> float:
    """Median of some runs after one to warm up."""
    action()
    taken = []
    for _ in range(repeats):
        start = time.perf_counter()
        action()
        taken.append(time.perf_counter() - start)
    return float(np.median(taken))


def _drive(folder: Path, length_m: float = 120.0, seed: int = 3) -> Path:
    from semloc_logs.simulation.drive_plan import Route, Town
    from semloc_logs.simulation.sensors.sensor import Sensor
    from semloc_logs.simulation.sessions import simulate_sessions

    simulate_sessions(folder, Town(seed), Route(1, length_m), Sensor(rate_hz=4.0), overwrite=True)
    return folder / "session_0.mcap"


def reading(settings: Resolved) -> Figures:
    """All messages of a simulated MCAP log, undecoded: MB of payload a second; and clouds decoded
    and posed.
    """
    from mcap.reader import make_reader

    from semloc_logs.logs.containers.open import open_log
    from semloc_logs.logs.session.session import open_session

    with tempfile.TemporaryDirectory(prefix="semloc-") as folder:
        log = _drive(Path(folder))
        payload = 0

        def ours() -> int:
            opened = open_log(log)
            try:
                return sum(len(m.data) for m in opened.messages())
            finally:
                opened.close()

        def peer() -> int:
            with log.open("rb") as file:
                return sum(len(m.data) for _, _, m in make_reader(file).iter_messages())

        def clouds() -> int:
            session = open_session([log])
            try:
                return sum(1 for _ in session.clouds())
            finally:
                session.close()

        payload = ours()
        count = clouds()
        megabytes = payload / 1e6
        return {
            "messages": {
                "ours": megabytes / _seconds(ours),
                "unit": "MB/s",
                "mcap-python": megabytes / _seconds(peer),
            },
            "clouds": {"ours": 1e3 * _seconds(clouds) / max(count, 1), "unit": "ms a sweep"},
        }


def fusion(settings: Resolved) -> Figures:
    """Sweeps and depth images into the semantic map, free space carved; see
    :mod:`semloc_logs.benchmarks.speed.fusion_speed`.
    """
    from semloc_logs.benchmarks.speed.fusion_speed import fusion_speed

    return fusion_speed(settings)


def encoder(settings: Resolved) -> Figures:
    """Descriptors of a map, densely and one by one; see
    :mod:`semloc_logs.benchmarks.speed.encoder_speed`.
    """
    from semloc_logs.benchmarks.speed.encoder_speed import encoder_speed

    return encoder_speed(settings)


def search(settings: Resolved) -> Figures:
    """Words looked up; see :mod:`semloc_logs.benchmarks.speed.search_speed`."""
    from semloc_logs.benchmarks.speed.search_speed import search_speed

    return search_speed(settings)


def verification(settings: Resolved) -> Figures:
    """Hypotheses searched, fitted and judged; see
    :mod:`semloc_logs.benchmarks.speed.verification_speed`.
    """
    from semloc_logs.benchmarks.speed.verification_speed import verification_speed

    return verification_speed(settings)


def annotate(settings: Resolved) -> Figures:
    """A hundred closures into a simulated MCAP log in place, beside rewriting the log with
    mcap-python.
    """
    with tempfile.TemporaryDirectory(prefix="semloc-") as folder:
        log = _drive(Path(folder))
        records = _closure_records(log, CLOSURES)
        size = log.stat().st_size / 1e6
        taken = [_annotated(log, records[: CLOSURES - i]) for i in range(REPEATS)]
        rewritten = _seconds(lambda: _rewrite(log, Path(folder) / "copy.mcap"), 2)
        return {
            "in_place": {
                "ours": float(np.median(taken)),
                "unit": f"s for a log of {size:.0f} MB",
                "mcap-python": rewritten,
            }
        }


def _closure_records(log: Path, count: int) -> list[ClosureRecord]:
    """Closures with another session, evenly over the messages of ``log``."""
    from mcap.reader import make_reader

    from semloc_logs.logs.annotation.annotate import ClosureRecord

    with log.open("rb") as file:
        times = [m.log_time for _, _, m in make_reader(file).iter_messages()]
    stamps = [times[i * (len(times) - 1) // (count - 1)] for i in range(count)]
    ends = ("session_0", "other")
    position = (1.0, 0.0, 0.0)
    quaternion = (0.0, 0.0, 0.0, 1.0)
    covariance = tuple(np.eye(6).ravel().tolist())
    return [
        ClosureRecord(*ends, s, s, *position, *quaternion, covariance, 0.5, 0.999, 100, 10)
        for s in stamps
    ]


def _rewrite(log: Path, copy: Path) -> None:
    """Copy ``log`` message by message with mcap-python."""
    from mcap.reader import make_reader
    from mcap.writer import Writer

    with log.open("rb") as source, copy.open("wb") as target:
        writer = Writer(target)
        writer.start()
        channels: dict[int, int] = {}
        for schema, channel, m in make_reader(source).iter_messages():
            if channel.id not in channels:
                known = (
                    writer.register_schema(schema.name, schema.encoding, schema.data)
                    if schema
                    else 0
                )
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, known, channel.metadata
                )
            writer.add_message(channels[channel.id], m.log_time, m.data, m.publish_time, m.sequence)
        writer.finish()  # type: ignore[no-untyped-call]


def _annotated(log: Path, records: Sequence[ClosureRecord]) -> float:
    from semloc_logs.logs.annotation.annotate import Results, annotate_in_place

    start = time.perf_counter()
    annotate_in_place(
        log,
        Results(records, "session_0", {}, {r.query_stamp_ns: r.query_stamp_ns for r in records}),
    )
    return time.perf_counter() - start
