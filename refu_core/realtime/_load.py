"""Loads what is worn by whom: garments, a body, and the networks that were trained for them."""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping, Sequence
from os import PathLike

import torch

from refu_core.backbones import Skinned, backbone_weights, with_beyond, with_dynamics
from refu_core.body import ARMS, BodyFit, Collider, SmplBody, load_body, load_fit
from refu_core.errors import BodyError, GarmentError, WeightsError, require_type
from refu_core.garments import GarmentTemplate, load_garment, worn_on
from refu_core.modes import DEFAULT_MARGIN, BackboneName
from refu_core.realtime._wearer import Outfit, Wearable
from refu_core.refu import trained_from_weights
from refu_core.weights import Weights, weights_folder


def load_outfit(
    garments: Sequence[str | PathLike[str] | GarmentTemplate],
    *,
    body: str | PathLike[str] | SmplBody | None,
    betas_from: str | PathLike[str] | SmplBody | None,
    backbone: str,
    mode: str,
    weights: str | PathLike[str] | None,
    device: torch.device,
    collider: bool,
) -> Outfit:
    """Loads garments, the body that wears them, and their networks; arguments and errors as in `GarmentPipeline.load`.

    To a body that isn't their own, garments are transferred (`worn_on`).
    """
    templates = _templates(garments, device)
    if body is not None and betas_from is not None:
        msg = "a body and betas_from were both given: a body file's betas are its own already, leave betas_from out"
        raise BodyError(msg)
    named = betas_from if body is None else body
    fit = None if named is None else load_fit(named, betas_from=body is None, device=device)
    wearer = load_body(_cut_for(templates), device=device) if fit is None else fit.body
    wearables = {}
    for name, template in templates.items():
        stored = backbone_weights(backbone, name, mode=mode, folder=weights_folder(name, weights))
        if stored is None:
            wearables[name] = Wearable(worn_on(template, fit), Skinned(), None, DEFAULT_MARGIN)
        else:
            wearables[name] = wearable_of(stored, template, fit, backbone=backbone, device=device)
    return Outfit(wearer, wearables, Collider(wearer) if collider else None, fit)


def _templates(
    garments: Sequence[str | PathLike[str] | GarmentTemplate], device: torch.device
) -> dict[str, GarmentTemplate]:
    if isinstance(garments, (str, os.PathLike, GarmentTemplate)):
        garments = [garments]
    require_type(garments, Collection, "names of garments", error=GarmentError)
    if not len(garments):
        raise GarmentError("no garment was asked for: name at least one")
    loaded = [one if isinstance(one, GarmentTemplate) else load_garment(one) for one in garments]
    names = [template.name for template in loaded]
    if len(set(names)) < len(names):
        raise GarmentError(f"wanted garments of different names, got {', '.join(names)}: a person wears each once")
    return {template.name: template.to(device=device, dtype=torch.float32) for template in loaded}


def _cut_for(templates: Mapping[str, GarmentTemplate]) -> str:
    """The body that all garments were cut for. Raises `GarmentError` if they were cut for several."""
    bodies = {template.body for template in templates.values()}
    if len(bodies) > 1:
        cut_for = ", ".join(f"{name} ({template.body})" for name, template in templates.items())
        msg = f"one person wears garments of one body: got {cut_for}; name a body to have them transferred to it"
        raise GarmentError(msg)
    return bodies.pop()


def wearable_of(
    stored: Weights,
    template: GarmentTemplate,
    fit: BodyFit | None,
    *,
    backbone: str = BackboneName.TAILORNET,
    device: str | torch.device = "cpu",
) -> Wearable:
    """A garment as it was cut, with the networks in `stored`, put on the body of `fit`, or on its own body if None.

    The `backbone` decides whether dynamics beside them are used.

    Raises:
        WeightsError: the networks were trained on yet another body, or don't fit the garment.
    """
    worn = worn_on(template, fit)
    trained_on, source = stored.card.get("body_fingerprint"), load_body(template.body).fingerprint
    betas, size = None, 1.0
    if fit is not None and trained_on in fit.fingerprints:
        network, refu = trained_from_weights(stored, worn, device=device)
    elif trained_on == source:
        # Networks know the garment on the body that they were trained on.
        network, refu = trained_from_weights(stored, template, device=device)
        if worn is not template and fit is not None:
            betas, size = fit.difference(template.body).betas, fit.size
    else:
        own = "" if fit is None else f"{fit.body.name} ({fit.body.fingerprint}) or "
        hint = "name that body's file as the body, or " if fit is None else ""
        msg = (
            f"{stored.path}: trained on the body {trained_on}, wanted {own}the built-in {template.body} ({source}); "
            f"{hint}train some with `refu train {template.name} --body`"
        )
        raise WeightsError(msg)
    network = with_beyond(with_dynamics(backbone, network, stored), stored, template)
    margin = DEFAULT_MARGIN if refu is None else refu.margin
    feels_arms = all(joint in template.card.joints for arm in ARMS for joint in arm[:2])  # shoulders and elbows
    return Wearable(worn, network, refu, margin, betas, size, feels_arms and stored.card.get("knows_limbs") is True)
