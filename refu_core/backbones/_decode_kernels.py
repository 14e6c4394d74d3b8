"""The product of a few codes with a basis; matrix libraries are slow at that, as they are made for many rows."""

from typing import TYPE_CHECKING

import warp as wp

from refu_core import _warp  # noqa: F401  (quiets Warp before it starts)

WIDTH = 16
"""Columns of a strip: with four codes, as many sums as a CPU with 16 registers of eight numbers can keep in them."""
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

    Each `step` (R - K) is the size of one unit of `fine`.
    """
    s = wp.tid()
    whole = coarse.shape[1]
    i = int(0)
    while i + ROWS <= code.shape[0]:
        a = mean[s]
        b = mean[s]
        c = mean[s]
        d = mean[s]
        for r in range(whole):
            row = coarse[s, r]
            a += code[i, r] * row
            b += code[i + 1, r] * row
            c += code[i + 2, r] * row
            d += code[i + 3, r] * row
        for r in range(fine.shape[1]):
            row = Strip(fine[s, r])
            a += (code[i, whole + r] * step[r]) * row
            b += (code[i + 1, whole + r] * step[r]) * row
            c += (code[i + 2, whole + r] * step[r]) * row
            d += (code[i + 3, whole + r] * step[r]) * row
        decoded[i, s] = a
        decoded[i + 1, s] = b
        decoded[i + 2, s] = c
        decoded[i + 3, s] = d
        i += ROWS
    while i < code.shape[0]:
        a = mean[s]
        for r in range(whole):
            a += code[i, r] * coarse[s, r]
        for r in range(fine.shape[1]):
            a += (code[i, whole + r] * step[r]) * Strip(fine[s, r])
        decoded[i, s] = a
        i += 1
