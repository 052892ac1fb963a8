"""What was skipped while reading a log, in sentences for the user."""

from __future__ import annotations

from collections.abc import Collection


class Problems:
    """Sentences in the order in which they arose; skipped messages are counted per topic and named once."""

    def __init__(self) -> None:
        self._said: dict[str, None] = {}
        self._skipped: dict[str, tuple[int, str]] = {}

    def add(self, sentence: str) -> None:
        """Adds a sentence unless it is there."""
        self._said.setdefault(sentence)

    def skip(self, topic: str, reason: str) -> None:
        """Counts one skipped message of ``topic``; the first ``reason`` is the one that is told."""
        count, first = self._skipped.get(topic, (0, reason))
        self._skipped[topic] = (count + 1, first)

    def forget_skipped(self, topics: Collection[str] | None) -> None:
        """Starts the counts of ``topics`` (None: all) anew, before another pass meets the same messages again."""
        for topic in list(self._skipped):
            if topics is None or topic in topics:
                del self._skipped[topic]

    def sentences(self) -> list[str]:
        """All of them."""
        counted = [
            f"{topic}: {count} message{'s' if count > 1 else ''} skipped; {'the first because ' if count > 1 else ''}{reason}."
            for topic, (count, reason) in self._skipped.items()
        ]
        return [*self._said, *counted]
