"""Sessions, and pairs of them, that get no closures, since these would be false."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field

from semloc_logs.closures.other_mountings import Both, contradictions
from semloc_logs.closures.session_pairs import Pair
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.settings import Resolved


@dataclass(frozen=True, slots=True)
class Exclusions:
    """Why sessions get no closures: ``misfits`` of poses and range data by session.

    And why ``pairs`` get none: how the mountings of both contradict each other.
    """

    misfits: Mapping[str, list[str]] = field(default_factory=dict)
    pairs: Mapping[Both, str] = field(default_factory=dict)

    @classmethod
    def of(cls, maps: Mapping[str, SessionMap], settings: Resolved) -> Exclusions:
        """The ones of some sessions; none where the settings overrule them."""
        if settings.closures.misfits:
            return cls()
        misfits = {name: m.misfits for name, m in sorted(maps.items()) if m.misfits}
        fitting = {name: m for name, m in maps.items() if name not in misfits}
        return cls(misfits, contradictions(fitting))

    def has(self, pair: Pair) -> bool:
        """Whether a pair gets no closures."""
        return bool(self.reason(pair.query, pair.target))

    def reason(self, session: str, other: str) -> str:
        """Why two sessions, or one and itself, get no closures; empty where they may."""
        for name in (session, other):
            if name in self.misfits:
                return f"the poses of {name} do not fit"
        return self.pairs.get(Both((session, other)), "")

    def sentences(self) -> list[str]:
        """A sentence for each session, and for each contradiction between some."""
        return [
            *(
                f"Session {name} gets no closures: its poses do not fit ({'; '.join(misfits)});"
                " --set closures.misfits=true searches it all the same."
                for name, misfits in self.misfits.items()
            ),
            *(
                f"{_pairs_text(pairs)} with each other: {text}; give the right mounting with --set"
                " logs.mountings.FRAME=[x,y,z,qx,qy,qz,qw], or search them all the same with --set"
                " closures.misfits=true, as where they are of two vehicles."
                for text, pairs in _by_text(self.pairs).items()
            ),
        ]


def _by_text(pairs: Mapping[Both, str]) -> dict[str, list[Both]]:
    by_text: dict[str, list[Both]] = defaultdict(list)
    for pair, text in pairs.items():
        by_text[text].append(pair)
    return by_text


def _pairs_text(pairs: list[Both]) -> str:
    first = " and ".join(sorted(pairs[0]))
    if len(pairs) == 1:
        return f"Sessions {first} get no closures"
    return f"{len(pairs)} pairs of sessions, such as {first}, get no closures"
