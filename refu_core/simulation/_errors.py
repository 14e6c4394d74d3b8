"""Errors of the simulation."""

from refu_core.errors import RefuError


class SimulationError(RefuError, ValueError):
    """Motions, plans or data sets that don't fit together or can't be read."""
