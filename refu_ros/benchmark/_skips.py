"""What the pipeline skips."""

from collections.abc import Mapping

from refu_core import realtime

SKIPS: Mapping[str, str] = getattr(realtime, "SKIPS", {})
"""By name, with a line about each."""
