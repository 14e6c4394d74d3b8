"""Garments that follow what a depth camera sees of a person, but never into the body."""

from refu_core.observation._cloth import DEFAULT_OBSERVATION, ObservationSettings
from refu_core.observation._observer import Observer

__all__ = ["DEFAULT_OBSERVATION", "ObservationSettings", "Observer"]
