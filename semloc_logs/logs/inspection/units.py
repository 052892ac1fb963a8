"""Quantities for people."""

from __future__ import annotations


def distance(metres: float) -> str:
    """Such as ``2 cm``, ``28.9 m`` and ``1.2 km``."""
    if metres < 0.995:
        return f"{100 * metres:.0f} cm"
    return f"{metres:.1f} m" if metres < 999.95 else f"{metres / 1000:.1f} km"


def duration(seconds: float) -> str:
    """Such as ``43.5 s``, ``12 min 05 s`` and ``2 h 03 min``."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


def size(nbytes: int) -> str:
    """Such as ``30.7 MB``; decimal units."""
    value = float(nbytes)
    for unit in ("B", "kB", "MB", "GB"):
        if value < 999.5:
            return f"{value:.0f} B" if unit == "B" else f"{value:.3g} {unit}"
        value /= 1000
    return f"{value:.3g} TB"


def rate(hertz: float) -> str:
    """Such as ``10 Hz`` and ``7.5 Hz``; two digits are enough to tell sensors apart."""
    if hertz >= 20:
        return f"{hertz:.0f} Hz"
    return f"{round(hertz, 1):g} Hz" if hertz >= 1 else f"{hertz:.2g} Hz"


def number(count: int) -> str:
    """With commas: ``38,886``."""
    return f"{count:,}"
