"""Fuzzes the message decoders and the containers: python benchmarks/fuzz.py [--seed N] [--minutes
M] [--only decoders|layouts|logs].

Valid messages of every type that can be decoded, in cdr, ros1, protobuf and json, and small valid
logs are damaged; the same seed gives the same inputs. What comes out must be frames or a LogError,
in seconds. Anything else, and any warning of numpy, is kept in a folder with the command that
repeats it; exit code 1 when there is such a finding.
"""

from __future__ import annotations

import argparse
import random
import resource
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))
from fuzz_inputs import damage, layout, logs, messages

from semloc_logs.errors import LogError
from semloc_logs.logs.containers.open import open_log
from semloc_logs.logs.log import Message
from semloc_logs.logs.messages.decode import Decoder
from semloc_logs.logs.problems import Problems

# of processor time; a log's twenty definitions take one of them
LIMIT_S = {"decoders": 2.0, "layouts": 2.0, "logs": 10.0}
MEMORY = 2 << 30  # bytes beyond those at the start
SHOWN = 200  # characters of an error


class TooSlowError(BaseException):
    """Not an Exception: nothing under test may swallow it."""


def _alarm(_: int, __: FrameType | None) -> None:
    raise TooSlowError


# by definition: to parse those takes longer than to decode
_decoders: dict[int, tuple[Decoder, Problems]] = {}


def decode(message: Message, *, is_known: bool = False) -> None:
    """The frames of one message; ``is_known``: its definition is undamaged."""
    problems = Problems()
    decoder = Decoder(problems)
    if is_known:
        decoder, problems = _decoders.setdefault(id(message.definition), (decoder, problems))
        problems.forget_skipped(None)
    decoder.frames(message)
    sentences = problems.sentences()
    if any("MemoryError" in sentence for sentence in sentences):
        raise AssertionError(f"too much memory was requested: {sentences}")


def read(files: dict[str, bytes]) -> None:
    """The frames of one log, and its problems."""
    with tempfile.TemporaryDirectory() as folder:
        for name, content in files.items():
            Path(folder, name).write_bytes(content)
        path = Path(folder) if "metadata.yaml" in files else Path(folder, next(iter(files)))
        try:
            log = open_log(path)
        except LogError:
            return
        try:
            for _ in log.frames():
                pass
            if not all(isinstance(sentence, str) for sentence in log.problems):
                raise AssertionError("a problem is not a sentence")
        except LogError:
            pass
        finally:
            log.close()


def one(seed: int, only: str | None) -> tuple[str, float, Callable[[], None], Any]:
    """The name of the input of ``seed``, its limit in seconds, the function that tries it, and the
    input itself.
    """
    rng = random.Random(seed)
    kind = only or rng.choices(["decoders", "layouts", "logs"], [50, 30, 1])[0]
    if kind == "decoders":
        name, message = rng.choice(messages())
        message = message._replace(data=damage(rng, bytes(message.data)))
        is_known = rng.random() > 0.05
        if not is_known:
            definition = message.definition
            text = damage(rng, definition.text) if definition.text else b""
            message = message._replace(
                definition=type(definition)(definition.name, definition.encoding, text)
            )
        return name, LIMIT_S[kind], lambda: decode(message, is_known=is_known), message
    if kind == "layouts":
        message = layout(rng)
        return (
            f"layout {message.encoding}",
            LIMIT_S[kind],
            lambda: decode(message, is_known=True),
            message,
        )
    name, files = rng.choice(logs())
    files = {
        part: damage(rng, content) if rng.random() < 0.8 else content
        for part, content in files.items()
    }
    return name, LIMIT_S[kind], lambda: read(files), files


class Findings:
    """What the inputs of a run showed: errors, the slowest input, the growth of memory."""

    def __init__(self, keep: Path, only: str | None) -> None:
        self.kinds: Counter[str] = Counter()
        self.slowest = (0.0, "")  # s of processor time
        self.largest = (0.0, "")  # MiB by which the peak grew
        self.peak = _peak_mib()
        self._keep = keep
        self._only = only

    def attempt(self, seed: int) -> None:
        """Try the input of ``seed``."""
        name, limit_s, attempt, content = one(seed, self._only)
        signal.setitimer(signal.ITIMER_PROF, limit_s)
        start = time.process_time()
        try:
            attempt()
        except (Exception, TooSlowError) as error:
            signal.setitimer(signal.ITIMER_PROF, 0)
            self._add(seed, name, error, content)
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0)

        grown = _peak_mib() - self.peak
        if grown > 1:
            self.peak += grown
            self.largest = max(self.largest, (grown, f"{name} seed {seed}"))
        self.slowest = max(self.slowest, (time.process_time() - start, f"{name} seed {seed}"))

    def _add(self, seed: int, name: str, error: BaseException, content: Any) -> None:
        """Count a finding; the first one of its kind is kept in a file."""
        place = traceback.extract_tb(error.__traceback__)[-1]
        kind = f"{name}: {type(error).__name__} at {Path(place.filename).name}:{place.lineno}"
        self.kinds[kind] += 1
        if self.kinds[kind] > 1:
            return
        self._keep.mkdir(exist_ok=True)
        trace = "".join(traceback.format_exception(error))
        repeat = f"--seed {seed} --count 1 --only {self._only}"
        (self._keep / f"{seed}.txt").write_text(f"{trace}\n{repeat}\n{content!r}\n")
        print(f"seed {seed}: {kind}: {str(error)[:SHOWN]}", flush=True)


def _peak_mib() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main() -> int:
    """Run for some minutes, or with some inputs."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--seed", type=int, default=0, help="the first input; each further one has the next number"
    )
    parser.add_argument("--minutes", type=float, default=1.0)
    parser.add_argument("--count", type=int, default=None, help="inputs instead of minutes")
    parser.add_argument("--only", choices=["decoders", "layouts", "logs"])
    parser.add_argument(
        "--keep", type=Path, default=Path("fuzz-findings"), help="folder for findings"
    )
    options = parser.parse_args()

    warnings.simplefilter("error")
    messages()  # before memory is limited
    logs()
    signal.signal(signal.SIGPROF, _alarm)
    held = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (held + MEMORY, held + MEMORY))

    findings = Findings(options.keep, options.only)
    end = time.monotonic() + 60 * options.minutes
    done = 0
    while done < options.count if options.count is not None else time.monotonic() < end:
        findings.attempt(options.seed + done)
        done += 1

    kinds = findings.kinds
    print(f"{done} inputs, {sum(kinds.values())} findings of {len(kinds)} kinds")
    seconds, slowest = findings.slowest
    grown, largest = findings.largest
    print(
        f"slowest {seconds:.2f} s of processor ({slowest}); "
        f"peak memory {findings.peak:.0f} MiB, most by {grown:.0f} MiB ({largest})"
    )
    return 1 if kinds else 0


if __name__ == "__main__":
    sys.exit(main())
