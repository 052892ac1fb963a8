"""Topics that belong together by their names: pictures and calibrations, clouds and labels."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

# suffixes of image_transport: the same picture, recorded in another form
_TRANSPORTS = {"compressed", "compresseddepth", "theora", "ffmpeg", "zstd"}
_VIDEO = ("/theora", "/ffmpeg")  # pictures that depend on earlier ones are not decoded
_GENERIC_WORDS = {"camera", "info", "image"}  # topics that share only these are not related
_SEPARATORS = re.compile(r"[/_]")


def stem(topic: str) -> str:
    """The topic without its transport: /a/image/compressed -> /a/image."""
    parent, _, last = topic.rpartition("/")
    return parent if last.lower() in _TRANSPORTS and parent else topic


def one_transport(topics: Sequence[str]) -> list[str]:
    """Each picture once, the lossless one of several transports."""
    best: dict[str, str] = {}
    for topic in topics:
        if topic.lower().endswith(_VIDEO):
            continue
        if stem(topic) not in best or topic == stem(topic):
            best[stem(topic)] = topic
    return sorted(best.values())


def words(topic: str) -> set[str]:
    """The words of a topic's name, in lower case."""
    return set(_SEPARATORS.split(topic.lower().strip("/")))


def partners(topics: Iterable[str], candidates: Sequence[str], *, forced: bool) -> dict[str, str]:
    """For each topic the candidate that shares most of its namespace, then most words.

    A candidate that shares nothing is a partner only if it is the only one, or if ``forced``.
    """
    if not candidates:
        return {}
    partner_of = {}
    for topic in topics:
        best = min(candidates, key=lambda c: (-shared(topic, c), -_shared_words(topic, c), c))
        is_related = shared(topic, best) or _shared_words(topic, best)
        if forced or len(candidates) == 1 or is_related:
            partner_of[topic] = best
    return partner_of


def calibrations(
    pictures: Sequence[str], pair: Sequence[str], infos: Sequence[str], *, forced: bool
) -> dict[str, str]:
    """CameraInfo topic of each picture; the cameras of a stereo ``pair`` never share one.

    It goes to the one with the nearer name.
    """
    info_of = partners((*pictures, *pair), infos, forced=forced)
    if len(pair) == 2 and pair[0] in info_of and info_of[pair[0]] == info_of.get(pair[1]):
        left, right = ((shared(t, info_of[t]), _shared_words(t, info_of[t])) for t in pair)
        del info_of[pair[0] if right > left else pair[1]]
    return info_of


def label_meanings(
    labels: Sequence[str], lidar: Sequence[str], meanings: Sequence[str], *, forced: bool
) -> dict[str, str]:
    """The topic with the meaning of the labels, for each label image and LIDAR.

    Where there are label images, a LIDAR has only a topic in its own namespace.
    """
    of_lidar = partners(lidar, meanings, forced=forced and not labels)
    return partners(labels, meanings, forced=forced) | {
        topic: meaning
        for topic, meaning in of_lidar.items()
        if not labels or shared(topic, meaning)
    }


def shared(a: str, b: str) -> int:
    """Number of leading path elements that two topics share."""
    count = 0
    for x, y in zip(stem(a).strip("/").split("/"), stem(b).strip("/").split("/"), strict=False):
        if x != y:
            break
        count += 1
    return count


def _shared_words(a: str, b: str) -> int:
    return len(words(a) & (words(b) - _GENERIC_WORDS))
