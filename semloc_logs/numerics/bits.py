"""Instructions of the processor that count and find bits, for compiled functions."""

from __future__ import annotations

from typing import Any

from numba import types
from numba.extending import intrinsic


def _count_bits(_: Any, x: Any) -> Any:
    return types.int64(types.uint64), lambda context, builder, signature, arguments: builder.ctpop(
        arguments[0]
    )


def _first_bit(_: Any, x: Any) -> Any:
    def instruction(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        # undefined for 0, which callers exclude
        return builder.cttz(arguments[0], context.get_constant(types.boolean, True))

    return types.int64(types.uint64), instruction


popcount: Any = intrinsic(_count_bits)  # how many bits of an uint64 are set
lowest_bit: Any = intrinsic(_first_bit)  # and the number of the lowest of them
