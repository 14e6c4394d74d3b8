"""The product of a few codes with a basis, which libraries for matrices are slow at: they are made for many rows."""

from typing import TYPE_CHECKING, Any

import warp as wp

from refu_core import _warp  # noqa: F401  (quiets Warp before it starts)

WIDTH = 16
"""Columns of a strip: with four strips as many sums as a processor with 16 registers of eight numbers keeps in them."""
STREAMS = 4
"""Strips that a thread reads side by side: of one stream memory brings less than half as much in the same time."""


if TYPE_CHECKING:
    Strip = wp.Vector[float]
    HalfStrip = Any  # or it couldn't be converted
else:
    Strip = wp.types.vector(length=WIDTH, dtype=wp.float32)
    HalfStrip = wp.types.vector(length=WIDTH, dtype=wp.float16)


@wp.kernel(enable_backward=False)
def decode_kernel(
    code: wp.array2d[float],
    strips: wp.array2d[HalfStrip],
    mean: wp.array[Strip],
    # output
    decoded: wp.array2d[Strip],
) -> None:
    """Four strips of mean + code @ basis, of codes (B, R); `strips` (S, R) are those of the basis' rows."""
    s = wp.tid()
    apart = strips.shape[0] // wp.static(STREAMS)
    n = code.shape[1]
    for i in range(code.shape[0]):
        a = mean[s]
        b = mean[s + apart]
        c = mean[s + 2 * apart]
        d = mean[s + 3 * apart]
        r = int(0)
        while r < n:  # half the instructions of Warp's range
            x = code[i, r]
            a += x * Strip(strips[s, r])
            b += x * Strip(strips[s + apart, r])
            c += x * Strip(strips[s + 2 * apart, r])
            d += x * Strip(strips[s + 3 * apart, r])
            r += 1
        decoded[i, s] = a
        decoded[i, s + apart] = b
        decoded[i, s + 2 * apart] = c
        decoded[i, s + 3 * apart] = d
