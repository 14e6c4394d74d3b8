"""Numerical stability, measured: everyday and hostile frames, what collision handling promises, and endurance."""

from refu_lab.stress._checks import CHECKS
from refu_lab.stress._frames import FRAMES, everyday, promised
from refu_lab.stress._invariance import mirror_image
from refu_lab.stress._rounds import StressOptions, StressResult, replay_trial, run_stress
from refu_lab.stress._soak import (
    JUDGED_FROM,
    TOLERANCE,
    SoakResult,
    Yardstick,
    is_slower,
    resident_mb,
    soak,
    soak_frames,
)
from refu_lab.stress._subject import Subject, Wardrobe, distance_to_mesh
from refu_lab.stress._table import length, stress_table
from refu_lab.stress._trial import Check, Measurement, StressError, Tally, Trial, load_trial, save_trial

__all__ = [
    "CHECKS",
    "FRAMES",
    "JUDGED_FROM",
    "TOLERANCE",
    "Check",
    "Measurement",
    "SoakResult",
    "StressError",
    "StressOptions",
    "StressResult",
    "Subject",
    "Tally",
    "Trial",
    "Wardrobe",
    "Yardstick",
    "distance_to_mesh",
    "everyday",
    "is_slower",
    "length",
    "load_trial",
    "mirror_image",
    "promised",
    "replay_trial",
    "resident_mb",
    "run_stress",
    "save_trial",
    "soak",
    "soak_frames",
    "stress_table",
]
