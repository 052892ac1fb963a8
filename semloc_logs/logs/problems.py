"""What was skipped while reading a log, in sentences for the user."""

from __future__ import annotations

from collections.abc import Collection


class Problems:
    """Sentences in the order in which they arose; skipped messages are counted per topic and named
    once.
    """

    def __init__(self) -> None:
        self._said: dict[str, None] = {}
        self._skipped: dict[tuple[str, str], tuple[int, str]] = {}

    def add(self, sentence: str) -> None:
        """Adds a sentence unless it is there."""
        self._said.setdefault(sentence)

    def skip(self, stage: str, topic: str, reason: str) -> None:
        """Counts one message of ``topic`` that ``stage`` (reading, decoding) skipped; the first
        ``reason`` is the one that is told.
        """
        count, first = self._skipped.get((stage, topic), (0, reason))
        self._skipped[stage, topic] = (count + 1, first)

    def forget_skipped(self, stage: str, topics: Collection[str] | None) -> None:
        """Starts the counts of ``topics`` (None: all) anew, before another pass meets the same
        messages again.
        """
        for key in list(self._skipped):
            if key[0] == stage and (topics is None or key[1] in topics):
                del self._skipped[key]

    def sentences(self) -> list[str]:
        """All of them."""
        counted = [
            f"{topic}: {count} message{'s' if count > 1 else ''} skipped; {'the first because ' if count > 1 else ''}{reason}."
            for (_, topic), (count, reason) in self._skipped.items()
        ]
        return [*self._said, *counted]
