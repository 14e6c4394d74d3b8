"""Shared by all tests: one thread, where real motion lies, and how often properties are tried."""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

if importlib.util.find_spec("torch"):  # the adapters' tests run without it
    import torch

    torch.set_num_threads(1)  # as the node runs; and the figures of two test runs agree to the bit
settings.register_profile("refu", deadline=None, max_examples=40, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("refu")


@pytest.fixture(scope="session")
def motions() -> list[Path]:
    """Recorded human motion (AMASS-style npz); its folder is REFU_MOTIONS, or ../shared/motions beside the checkout."""
    default = Path(__file__).resolve().parents[2] / "shared" / "motions"
    folder = Path(os.environ.get("REFU_MOTIONS", default))
    clips = sorted(folder.glob("*.npz"))
    if not clips:
        pytest.skip(f"no recorded motion in {folder}: set REFU_MOTIONS to a folder of AMASS-style npz files")
    return clips
