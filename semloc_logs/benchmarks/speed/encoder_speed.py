"""Speed of the encoder: one subvolume after the other, over a whole map at once, on one and on all
cores, beside what the machine allows.

Multiply-accumulates are counted where they happen, layer by layer, on the shapes that pass; so
whatever the encoder's blocks are, the figures hold. The machine's peak is a plain matrix product in
bf16 with one thread. With one thread processor time counts, which other programs disturb less; on
all cores the clock on the wall. A dense descriptor needs fewer multiplications than a single one,
because neighbouring subvolumes share their first layers.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils._python_dispatch import TorchDispatchMode

from semloc_logs.errors import SemlocError
from semloc_logs.settings import Resolved
from semloc_logs.subvolumes.cut import WIDE, code_table
from semloc_logs.subvolumes.network import Encoder, descriptors, random_encoder
from semloc_logs.training.pairs import fuse
from semloc_logs.training.scene_shards import scene_frame
from semloc_logs.training.training_scenes import training_scene

Figures = dict[str, dict[str, float | str]]
EDGE = 192  # voxels of the piece of map, margin included
SINGLES = 40  # subvolumes that are encoded one by one
REPEATS = 5
MATRIX = 2048
ROUNDING = 0.01  # of a coordinate of a unit descriptor: bf16 has 8 binary digits


def encoder_speed(settings: Resolved) -> Figures:
    """ms a descriptor, multiply-accumulates a descriptor, their rate, the difference between ways,
    and the share of each layer.
    """
    threads = torch.get_num_threads()
    cores = os.cpu_count() or 1
    try:
        torch.set_num_threads(1)
        network = random_encoder("semantic")
        codes = _piece(settings)
        size = (EDGE - WIDE) // 8 + 1
        corners = np.stack(
            np.unravel_index(
                np.random.default_rng(0).choice(size * size, min(SINGLES, size * size), False),
                (size, size),
            ),
            1,
        )
        whole = encode(network, codes).reshape(size, size, -1)
        alone = one_by_one(network, codes, corners)
        work = {
            "one by one": macs(network, codes[:WIDE, :WIDE]),
            "dense": macs(network, codes) / size**2,
        }
        taken = {"one by one": _median(lambda: one_by_one(network, codes, corners)) / len(corners)}
        taken["dense"] = _median(lambda: encode(network, codes)) / size**2
        peak = MATRIX**3 / _median(_product()) / 1e9
        figures: Figures = {}
        for way, seconds in taken.items():
            rate = work[way] / seconds / 1e9
            figures[way] = {
                "ours": 1e3 * seconds,
                "unit": "ms a descriptor, one thread",
                "mega_macs": work[way] / 1e6,
            }
            figures[way] |= {
                "giga_macs_a_second": rate,
                "share_of_peak": rate / peak,
                "least_ms": work[way] / peak / 1e6,
            }
        figures["bf16 matrix product"] = {
            "ours": peak,
            "unit": "10^9 multiply-accumulates a second, one thread",
        }
        figures |= _on_cores(network, codes, whole.reshape(size**2, -1), cores)
        apart = float(np.abs(whole[corners[:, 0], corners[:, 1]] - alone).max())
        unlike = float(np.abs(np.roll(alone, 1, axis=0) - alone).max())
        figures["dense beside one by one"] = {
            "ours": apart,
            "unit": "largest difference of a coordinate",
            "other_subvolumes": unlike,
        }
        if max(apart, *(float(row.get("difference", 0.0)) for row in figures.values())) > ROUNDING:
            raise SemlocError(
                f"Descriptors of one map differ by {apart:.3f} between ways to encode it, "
                "more than bf16 rounds."
            )
        figures |= layers(network, codes)
        return figures
    finally:
        torch.set_num_threads(threads)


def _piece(settings: Resolved) -> NDArray[np.uint8]:
    """Codes (EDGE, EDGE, 32) of the middle of a simulated street."""
    blocks = fuse([scene_frame(frame) for frame in training_scene(4, 24).mapped], settings.fusion)
    low, high = blocks.bounds()
    middle = (low + high) // 2
    state = blocks.dense(
        np.array([middle[0] - EDGE // 2, middle[1] - EDGE // 2, -8]), (EDGE, EDGE, 32)
    )
    return np.ascontiguousarray(code_table("semantic")[state])


@torch.inference_mode()
def encode(network: Encoder, codes: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Unit descriptors (i * j, N) of codes (x, y, 32), margin included, as maps are described."""
    with torch.autocast("cpu", dtype=torch.bfloat16):
        return np.asarray(
            descriptors(network(torch.from_numpy(np.ascontiguousarray(codes))[None])).numpy()
        )


def one_by_one(
    network: Encoder, codes: NDArray[np.uint8], corners: NDArray[np.int64]
) -> NDArray[np.float32]:
    """Unit descriptors (n, N) of the subvolumes at ``corners`` (n, 2), in steps of 8 voxels, each
    by itself.
    """
    return np.concatenate(
        [encode(network, codes[8 * i : 8 * i + WIDE, 8 * j : 8 * j + WIDE]) for i, j in corners]
    )


class _Watched(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Seconds and multiply-accumulates of the convolutions of a run, in their order."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.seen: list[tuple[float, int]] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        start = time.process_time()
        output = func(*args, **(kwargs or {}))
        if func in (torch.ops.aten.conv2d.default, torch.ops.aten.conv3d.default):
            self.seen.append(
                (time.process_time() - start, output.numel() * math.prod(args[1].shape[1:]))
            )
        return output


def watch(network: Encoder, codes: NDArray[np.uint8]) -> dict[str, tuple[float, int]]:
    """Seconds and multiply-accumulates of each convolution, and of all between them ("between"), in
    one run over ``codes``.
    """
    with _Watched() as watched:
        start = time.process_time()
        encode(network, codes)
        total = time.process_time() - start
    seen = {f"convolution {n}": what for n, what in enumerate(watched.seen, 1)}
    return seen | {"between": (total - sum(s for s, _ in seen.values()), 0)}


def macs(network: Encoder, codes: NDArray[np.uint8]) -> int:
    """Multiply-accumulates of one run over codes (x, y, 32)."""
    return sum(count for _, count in watch(network, codes).values())


def layers(network: Encoder, codes: NDArray[np.uint8]) -> Figures:
    """ms, share of the multiplications and rate of each layer, medians; what lies between them is
    the first block, pooling and ReLU.
    """
    runs = [watch(network, codes) for _ in range(REPEATS + 1)][1:]
    total = sum(count for _, count in runs[0].values())
    out: Figures = {}
    for name in runs[0]:
        seconds = float(np.median([run[name][0] for run in runs]))
        count = runs[0][name][1]
        out[name] = {
            "ours": 1e3 * seconds,
            "unit": "ms of a dense run",
            "share_of_macs": count / total,
        }
        if count:
            out[name]["giga_macs_a_second"] = count / max(seconds, 1e-9) / 1e9
    return out


def _on_cores(
    network: Encoder, codes: NDArray[np.uint8], expected: NDArray[np.float32], cores: int
) -> Figures:
    """The dense run on all cores by threads and by processes, and how far descriptors differ from
    the times of one thread.
    """
    torch.set_num_threads(cores)
    by_threads = _median(lambda: encode(network, codes), time.perf_counter) / len(expected)
    other = float(np.abs(encode(network, codes) - expected).max())
    torch.set_num_threads(1)
    weights = {k: v.numpy() for k, v in network.state_dict().items()}
    with ProcessPoolExecutor(
        cores,
        mp_context=get_context("spawn"),
        initializer=_begin,
        initargs=(network.variant, weights, codes),
    ) as pool:
        list(pool.map(_run, [1] * cores))
        start = time.perf_counter()
        list(pool.map(_run, [REPEATS] * cores))
        by_processes = (time.perf_counter() - start) / (REPEATS * cores * len(expected))
        apart = float(np.abs(pool.submit(_run, 1).result() - expected).max())
    unit = f"ms a descriptor, {cores} cores"
    return {
        "dense, threads": {"ours": 1e3 * by_threads, "unit": unit, "difference": other},
        "dense, processes": {"ours": 1e3 * by_processes, "unit": unit, "difference": apart},
    }


_work: list[Any] = []  # of a process of the pool: the network and the codes


def _begin(variant: str, weights: dict[str, NDArray[Any]], codes: NDArray[np.uint8]) -> None:
    torch.set_num_threads(1)
    network = random_encoder(variant)
    network.load_state_dict({k: torch.from_numpy(v) for k, v in weights.items()})
    _work[:] = [network, codes]


def _run(times: int) -> NDArray[np.float32]:
    for _ in range(times):
        encoded = encode(*_work)
    return encoded


def _product() -> Callable[[], Any]:
    a, b = (
        torch.randn(MATRIX, MATRIX, generator=torch.Generator().manual_seed(k)).bfloat16()
        for k in range(2)
    )
    return lambda: a @ b


def _median(action: Callable[[], Any], clock: Callable[[], float] = time.process_time) -> float:
    """Median seconds of some runs after one to warm up."""
    action()
    taken = []
    for _ in range(REPEATS):
        start = clock()
        action()
        taken.append(clock() - start)
    return float(np.median(taken))
