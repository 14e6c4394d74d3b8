"""The product of a few codes with a basis; matrix libraries are slow at that, as they are made for many rows."""

from typing import TYPE_CHECKING

import warp as wp

from refu_core import _warp  # noqa: F401  (quiets Warp before it starts)

WIDTH = 32
"""Columns of a strip. With 16, as many sums as a CPU with 16 registers of eight numbers can keep in them with four
codes, one code takes 1.4 times as long, and four 1.7 times with AVX-512; on such a CPU, four take 0.8 times as long."""
ROWS = wp.constant(4)
"""How many codes a strip is multiplied by at a time."""

if TYPE_CHECKING:
    Strip = wp.Vector[float]
    Steps = wp.Vector[wp.int8]
else:
    Strip = wp.types.vector(length=WIDTH, dtype=wp.float32)
    Steps = wp.types.vector(length=WIDTH, dtype=wp.int8)


@wp.kernel(enable_backward=False)
def decode_kernel(
    code: wp.array2d[float],
    coarse: wp.array2d[Strip],
    fine: wp.array2d[Steps],
    step: wp.array[float],
    mean: wp.array[Strip],
    # output
    decoded: wp.array2d[Strip],
) -> None:
    """One strip of mean + code @ basis, of codes (B, R); `coarse` (S, K) and `fine` (S, R - K) are the basis' rows.

    Each `step` (R - K) is the size of one unit of `fine`. A range of unknown length would be a third slower here.
    """
    s = wp.tid()
    whole = coarse.shape[1]
    i = int(0)
    while i + ROWS <= code.shape[0]:
        a = mean[s]
        b = mean[s]
        c = mean[s]
        d = mean[s]
        r = int(0)
        while r < code.shape[1]:
            row = Strip()
            if r < whole:  # noqa: SIM108 - an expression would read both
                row = coarse[s, r]
            else:
                row = step[r - whole] * Strip(fine[s, r - whole])
            a += code[i, r] * row
            b += code[i + 1, r] * row
            c += code[i + 2, r] * row
            d += code[i + 3, r] * row
            r += 1
        decoded[i, s] = a
        decoded[i + 1, s] = b
        decoded[i + 2, s] = c
        decoded[i + 3, s] = d
        i += ROWS
    while i < code.shape[0]:
        a = mean[s]
        r = int(0)
        while r < code.shape[1]:
            if r < whole:
                a += code[i, r] * coarse[s, r]
            else:
                a += code[i, r] * (step[r - whole] * Strip(fine[s, r - whole]))
            r += 1
        decoded[i, s] = a
        i += 1
