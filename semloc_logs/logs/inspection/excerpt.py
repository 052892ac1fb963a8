"""The messages that an inspection reads: all of a small log, a sample of a large one.

The index of a log tells what its sections hold, so a sample costs the same whatever the length of
the log.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Sequence

import numpy as np

from semloc_logs.logs.log import Log, Message, Section

WHOLE_BYTES = 64 << 20  # a log of this size is read whole: a fraction of a second
MOST_SAMPLES = 40  # sections that are spread evenly over a larger log
_SAMPLE_BYTES = 128 << 20
_SEARCH_BYTES = 32 << 20  # are read in search of the first message of each topic


class Excerpt:
    """Messages of ``log`` in log-time order by sections.

    ``sampled`` topics are read in evenly spread sections. ``missing`` topics are read until the
    caller takes them out of the set, each in a bounded number of bytes. ``is_complete``: all
    messages are read, because the log is small or because of ``full``; ``samples`` is the number of
    sections that are read for the ``sampled`` topics.
    """

    def __init__(
        self, log: Log, sampled: Collection[str], missing: set[str], *, full: bool
    ) -> None:
        self._log = log
        self._sampled = frozenset(sampled)
        self._missing = missing
        self._sections: Sequence[Section] = [] if full else log.sections()
        self.is_complete = full or sum(s.nbytes for s in self._sections) <= WHOLE_BYTES
        self._chosen = frozenset() if self.is_complete else self._samples()
        self.samples = len(self._chosen)

    def messages(self) -> Iterator[Message]:
        """All messages, or the messages of the sample."""
        if self.is_complete:
            yield from self._log.messages()
            return
        spent: Counter[str] = Counter()
        for number, section in enumerate(self._sections):
            sampled = self._sampled if number in self._chosen else frozenset()
            if not sampled and not self._missing:
                continue
            searched = self._missing & section.topics if section.topics else set(self._missing)
            searched = {topic for topic in searched if spent[topic] < _SEARCH_BYTES}
            if searched or sampled:
                yield from section.messages(searched | sampled)
            for topic in searched:
                spent[topic] += section.nbytes

    def _samples(self) -> frozenset[int]:
        """Numbers of the sections that are read for the sampled topics: the ends, and between."""
        candidates = [
            number
            for number, section in enumerate(self._sections)
            if not section.topics or not section.topics.isdisjoint(self._sampled)
        ]
        if not candidates:
            return frozenset()
        mean = sum(self._sections[number].nbytes for number in candidates) / len(candidates)
        most = int(min(MOST_SAMPLES, max(_SAMPLE_BYTES / max(mean, 1.0), 2)))
        chosen = np.linspace(0, len(candidates) - 1, most).round().astype(int)
        return frozenset(candidates[i] for i in chosen)
