"""Figures of speed on data made here and now, each beside what else does the same in the same run.

Every benchmark returns ``{figure: {"ours": number, "unit": ..., PEER: number, ...}}``; a peer that is not installed is left out.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from semloc_logs.errors import SettingsError
from semloc_logs.settings import Settings

if TYPE_CHECKING:
    from semloc_logs.logs.annotate import ClosureRecord

Figures = dict[str, dict[str, float | str]]
REPEATS = 5


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
    from semloc_logs.simulation.sessions import simulate_sessions

    simulate_sessions(folder, seed=seed, sessions=1, length_m=length_m, rate_hz=4.0, overwrite=True)
    return folder / "session_0.mcap"


def reading(settings: Settings) -> Figures:
    """All messages of a simulated MCAP log, undecoded: MB of payload a second; and clouds decoded and posed."""
    from mcap.reader import make_reader

    from semloc_logs.logs.open import open_log
    from semloc_logs.logs.session import open_session

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
            session = open_session([log], {})
            try:
                return sum(1 for _ in session.clouds())
            finally:
                session.close()

        payload, count = ours(), clouds()
        megabytes = payload / 1e6
        return {
            "messages": {"ours": megabytes / _seconds(ours), "unit": "MB/s", "mcap-python": megabytes / _seconds(peer)},
            "clouds": {"ours": 1e3 * _seconds(clouds) / max(count, 1), "unit": "ms a sweep"},
        }


def fusion(settings: Settings) -> Figures:
    """Sweeps and depth images into the semantic map, free space carved; see :mod:`semloc_logs.evaluation.fusion_speed`."""
    from semloc_logs.evaluation.fusion_speed import fusion_speed

    return fusion_speed(settings)


def encoder(settings: Settings) -> Figures:
    """Descriptors of a map of 192 x 192 x 32 voxels: all at once, fully convolutionally, and one subvolume after the other."""
    import torch

    from semloc_logs.simulation.training_scenes import training_session
    from semloc_logs.subvolumes.cut import WIDE, code_table
    from semloc_logs.subvolumes.describe import describe_map, random_encoder
    from semloc_logs.subvolumes.pairs import SceneFrame, fuse

    blocks = fuse([SceneFrame(*frame[:2], frame[2], frame[3]) for frame in training_session(4, 24)], settings.fusion)
    low, high = blocks.bounds()
    middle = (low + high) // 2
    corner = np.array([middle[0] - 96, middle[1] - 96, -8])
    state = blocks.dense(corner, (192, 192, 32))
    network = random_encoder("semantic")

    def whole() -> int:
        return len(describe_map(state, corner, 0.0, settings.fusion.voxel_size, network, 8, settings.descriptor.min_occupied).descriptor)

    one = torch.from_numpy(code_table("semantic")[np.ascontiguousarray(state[:WIDE, :WIDE])[None]])

    def single() -> None:
        with torch.inference_mode(), torch.autocast("cpu", dtype=torch.bfloat16):
            network(one)

    count = max(whole(), 1)
    return {"descriptor": {"ours": 1e3 * _seconds(whole) / count, "unit": f"ms each of {count}", "one_by_one": 1e3 * _seconds(single)}}


def search(settings: Settings) -> Figures:
    """The five nearest of 300,000 words for each of 2,000 descriptors, beside all codes compared with numpy (and faiss if installed)."""
    from semloc_logs.words.index import Index
    from semloc_logs.words.vocabulary import train_vocabulary

    rng = np.random.default_rng(0)
    centres = rng.standard_normal((4000, 256)).astype(np.float32)
    drawn = centres[rng.integers(len(centres), size=302_000)] + 0.6 * rng.standard_normal((302_000, 256), np.float32)
    drawn /= np.linalg.norm(drawn, axis=1, keepdims=True)
    database, queries = drawn[:300_000], drawn[300_000:]
    vocabulary = train_vocabulary(database[:20_000])
    word, code = vocabulary.words(database)
    index = Index(vocabulary, word, code, np.zeros(len(word), np.int64))
    allowed, probes = np.ones(1, bool), settings.closures.probes
    asked = vocabulary.codes(queries, vocabulary.nearest_cells(queries, 1)[:, 0])

    def ours() -> None:
        index.search(queries, 5, probes, allowed)

    def unpacked(x: NDArray[np.uint64]) -> NDArray[np.integer]:
        return np.asarray(np.unpackbits(x.view(np.uint8)).reshape(-1, 64).sum(1))

    count_bits = getattr(np, "bitwise_count", unpacked)  # from numpy 2.0 on

    def brute() -> None:
        for q in asked[:20]:
            np.argpartition(count_bits(code ^ q), 5)

    figures: dict[str, float | str] = {"ours": _seconds(ours), "unit": "s for 2000 queries", "numpy": _seconds(brute, 3) * len(asked) / 20}
    if find_spec("faiss") is not None:
        peer = import_module("faiss").IndexBinaryFlat(64)
        peer.add(code.view(np.uint8).reshape(-1, 8))
        figures["faiss_flat"] = _seconds(lambda: peer.search(asked.view(np.uint8).reshape(-1, 8), 5), 2)
    return {"top5": figures}


def annotate(settings: Settings) -> Figures:
    """A hundred closures into a simulated MCAP log in place, beside rewriting the log with mcap-python."""
    from mcap.reader import make_reader
    from mcap.writer import Writer

    from semloc_logs.logs.annotate import ClosureRecord

    with tempfile.TemporaryDirectory(prefix="semloc-") as folder:
        log = _drive(Path(folder))
        with log.open("rb") as file:
            times = [m.log_time for _, _, m in make_reader(file).iter_messages()]
        stamps = [times[i * (len(times) - 1) // 99] for i in range(100)]
        covariance = tuple(np.eye(6).ravel().tolist())
        records = [
            ClosureRecord("session_0", "other", s, s, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, covariance, 0.5, 0.999, 100, 10) for s in stamps
        ]

        def rewrite() -> None:
            with log.open("rb") as source, (Path(folder) / "copy.mcap").open("wb") as target:
                writer = Writer(target)
                writer.start()
                channels: dict[int, int] = {}
                for schema, channel, m in make_reader(source).iter_messages():
                    if channel.id not in channels:
                        known = writer.register_schema(schema.name, schema.encoding, schema.data) if schema else 0
                        channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, known, channel.metadata)
                    writer.add_message(channels[channel.id], m.log_time, m.data, m.publish_time, m.sequence)
                writer.finish()  # type: ignore[no-untyped-call]

        size = log.stat().st_size / 1e6
        taken = [_annotated(log, records[: 100 - i]) for i in range(REPEATS)]
        return {"in_place": {"ours": float(np.median(taken)), "unit": f"s for a log of {size:.0f} MB", "mcap-python": _seconds(rewrite, 2)}}


def _annotated(log: Path, records: Sequence[ClosureRecord]) -> float:
    from semloc_logs.logs.annotate import Results, annotate_in_place

    start = time.perf_counter()
    annotate_in_place(log, Results(records, "session_0", {}, {r.query_stamp_ns: r.query_stamp_ns for r in records}))
    return time.perf_counter() - start


BENCHMARKS: dict[str, Callable[[Settings], Figures]] = {
    "reading": reading,
    "fusion": fusion,
    "encoder": encoder,
    "search": search,
    "annotate": annotate,
}


def run_benchmark(name: str, settings: Settings) -> Figures:
    """The figures of one benchmark; SettingsError when there is none of that name."""
    if name not in BENCHMARKS:
        raise SettingsError(f"There is no benchmark '{name}': there are {', '.join(BENCHMARKS)}.")
    return BENCHMARKS[name](settings)
