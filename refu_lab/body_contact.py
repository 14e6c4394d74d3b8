"""Where bodies of several shapes touch themselves."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from refu_core.body import SmplBody
from refu_core.metrics import SelfContact, SelfContactDetector


class BodyContact:
    """The self-contact of a body model; which faces overlap at rest already (toes) depends on the shape."""

    def __init__(self, body: SmplBody) -> None:
        """Detectors are made as shapes come; the last of them are kept, and of what they found."""
        self._body = body
        self._faces = body.faces.cpu().numpy()
        self._detector = lru_cache(maxsize=64)(self._make_detector)
        self._detect = lru_cache(maxsize=64)(self._detect_anew)

    def detect(self, betas: ArrayLike, vertices: NDArray[np.float32]) -> SelfContact:
        """Of a body of shape β (10,) with posed `vertices` [m], shape (V, 3)."""
        return self._detect(np.asarray(betas, np.float32).tobytes(), np.asarray(vertices, np.float32).tobytes())

    def _detect_anew(self, betas: bytes, vertices: bytes) -> SelfContact:
        return self._detector(betas).detect(np.frombuffer(vertices, np.float32).reshape(-1, 3).copy())

    def _make_detector(self, betas: bytes) -> SelfContactDetector:
        shape = self._body.v_template.new_tensor(np.frombuffer(betas, np.float32))[None]
        return SelfContactDetector(self._faces, self._body.rest_vertices(shape)[0].cpu().numpy())
