"""SMPL's joints by name, in SMPL's order."""

from __future__ import annotations

from refu_core.skeleton import JOINT_NAMES as SMPL_JOINTS

__all__ = ["SMPL_JOINTS"]
