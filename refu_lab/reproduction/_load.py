"""Finds and loads what training made."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from refu_core.body import load_fit
from refu_core.errors import WeightsError
from refu_core.garments import load_garment
from refu_core.modes import BackboneName
from refu_core.realtime import GarmentPipeline, Wearable, wearable_of
from refu_core.weights import load_weights, weights_folder
from refu_lab.reproduction._methods import Method


class Library:
    """Trained weights: those in given folders, `<folder>/<garment>/<weights>`, before those that ship."""

    def __init__(self, folders: Sequence[Path] = (), *, collider: bool = True, body: str | None = None) -> None:
        """Searches `folders` first, in their order; collisions are resolved against the collider or against the skin.

        Networks are loaded for a `body`, given by name or file; None takes the one that each garment is made for.

        Raises `BodyError` if there is no such body, or garments can't be transferred to it.
        """
        self._folders = tuple(folders)
        self.collider = collider
        self.fit = None if body is None else load_fit(body)
        self._named = body

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickled without the body, which another process loads itself."""
        return partial(Library, collider=self.collider, body=self._named), (self._folders,)

    def find(self, name: str, garment: str) -> Path:
        """Path of the files of a garment's weights, without suffix. Raises `WeightsError` if there are none."""
        for folder in (weights_folder(garment, root) for root in (*self._folders, None)):
            if (folder / f"{name}.json").exists():
                return folder / name
        msg = "not trained"
        raise WeightsError(msg)

    def load(self, method: Method, garment: str) -> Wearable:
        """A method's networks. Raises `WeightsError` if they are missing, damaged or for another body."""
        assert method.weights is not None
        stored = load_weights(self.find(method.weights, garment), expect={"garment": garment})
        return wearable_of(stored, load_garment(garment), self.fit)

    def pipeline(self, method: Method, *garments: str) -> GarmentPipeline:
        """The node's pipeline if the method is the node in some mode, else its backbone without collision handling.

        Raises `RefuError` if the garments, worn together, don't all have weights in one folder.
        """
        weights = None if method.weights is None else self.find(method.weights, garments[0]).parent.parent
        is_node = method.handling == "node"
        return GarmentPipeline.load(
            garments,
            body=None if self.fit is None else self.fit.body,
            sdf=method.mode if is_node else "none",
            backbone=BackboneName.AUTO if is_node and method.weights is not None else method.backbone,
            weights=weights,
            collider=self.collider,
        )
