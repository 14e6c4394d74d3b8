"""The product of a few codes with a basis, which libraries for matrices are slow at: they are made for many rows."""

from typing import TYPE_CHECKING

import warp as wp

from refu_core import _warp  # noqa: F401  (quiets Warp before it starts)

WIDTH = 16
"""Columns of a strip: with four codes as many sums as a processor with 16 registers of eight numbers keeps in them."""
ROWS = wp.constant(4)
"""Codes that a strip is multiplied by at a time."""


if TYPE_CHECKING:
    Strip = wp.Vector[float]
else:
    Strip = wp.types.vector(length=WIDTH, dtype=wp.float32)


@wp.kernel(enable_backward=False)
def decode_kernel(
    code: wp.array2d[float],
    strips: wp.array2d[Strip],
    mean: wp.array[Strip],
    # output
    decoded: wp.array2d[Strip],
) -> None:
    """One strip of mean + code @ basis, of codes (4 n, R); `strips` (S, R) are those of the basis' rows."""
    s = wp.tid()
    for i in range(0, code.shape[0], ROWS):
        a = mean[s]
        b = mean[s]
        c = mean[s]
        d = mean[s]
        for r in range(code.shape[1]):
            row = strips[s, r]
            a += code[i, r] * row
            b += code[i + 1, r] * row
            c += code[i + 2, r] * row
            d += code[i + 3, r] * row
        decoded[i, s] = a
        decoded[i + 1, s] = b
        decoded[i + 2, s] = c
        decoded[i + 3, s] = d
