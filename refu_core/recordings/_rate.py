"""Frame rates: what is one, and how many frames there are at another."""

from __future__ import annotations

FPS_RANGE = (1e-3, 10_000.0)
"""Frames a second that anything is recorded or sampled at: a frame in a quarter of an hour, and ten a millisecond."""
MAX_FRAMES = 1_000_000
"""Of a clip: nine hours at 30 Hz."""


def check_fps(fps: float) -> float:
    """The frame rate. Raises `ValueError` for one outside `FPS_RANGE`."""
    low, high = FPS_RANGE
    if not low <= fps <= high:
        msg = f"wanted a frame rate in [{low:g}, {high:g}], got {fps:g}; --fps says it otherwise"
        raise ValueError(msg)
    return float(fps)


def n_resampled(n: int, fps: float, wanted: float) -> int:
    """Frames that `n` frames at `fps` become at the rate `wanted`. Raises `ValueError` for more than `MAX_FRAMES`."""
    count = int((n - 1) / fps * check_fps(wanted) + 1e-9) + 1
    if count > MAX_FRAMES:
        msg = f"{n} frames at {fps:g} Hz are {count} at {wanted:g} Hz, at most {MAX_FRAMES} are made; cut the clip"
        raise ValueError(msg)
    return count
