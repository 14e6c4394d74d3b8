"""Garments that follow what a depth camera sees of a person, but never into the body."""

from refu_core.observation._observer import Observer
from refu_core.observation._settings import DEFAULT_OBSERVATION, ObservationSettings

__all__ = ["DEFAULT_OBSERVATION", "ObservationSettings", "Observer"]
