"""Who wears the garments of a replay: what is known of the body, and what there is to warn of."""

from __future__ import annotations

import re
from typing import Any

from refu_core import GarmentPipeline
from refu_core.body import BodyFit
from refu_core.recordings import GENDERS


def body_facts(pipeline: GarmentPipeline) -> dict[str, Any]:
    """Plain values, ready for JSON; of a body that was named, how far the built-in mesh is from its surface [mm]."""
    facts: dict[str, Any] = {"name": pipeline.body.name, "fingerprint": pipeline.body.fingerprint}
    return facts if pipeline.fit is None else facts | fit_facts(pipeline.fit)


def fit_facts(fit: BodyFit) -> dict[str, float]:
    """How far the built-in mesh is from the body's surface, hands, feet and head left out [mm]."""
    found = fit.registration
    return {"fit_mean_mm": 1e3 * found.mean_distance, "fit_p99_mm": 1e3 * found.far_distance}


def body_warnings(pipeline: GarmentPipeline, *, gender: str = "") -> list[str]:
    """What there is to warn of, for a recording that says it is of a `gender`, or (empty) doesn't."""
    warnings = pipeline.warnings
    known = _gender_of(pipeline.body.name)
    said = gender.strip().lower()
    if said in ("male", "female") and known and said != known:
        warnings.append(
            f"the recording is of a {said} body and is dressed as {pipeline.body.name}: name a body (body, "
            f"--body {said} or a file), and garments are transferred to it"
        )
    return warnings


def _gender_of(body: str) -> str:
    """Whose body it is by its name, as `SMPL_FEMALE` and `basicModel_f_lbs_10_207_0_v1.0.0` are; empty if unsaid."""
    words = [word for word in re.split(r"[^a-z]+", body.lower()) if word in GENDERS]
    return GENDERS[words[0]] if words else ""
