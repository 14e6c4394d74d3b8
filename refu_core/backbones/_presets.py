"""Backbones by name: untrained, from a preset; and on disk, `<name>-<mode>` and, shared by low-rank heads, `basis`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn import Module

from refu_core._files import read_json
from refu_core._warp import memory
from refu_core.backbones._beyond import KINDS, Beyond, BeyondConfig, WithBeyond
from refu_core.backbones._decoder import BasisDecoder, Decoder, DenseDecoder
from refu_core.backbones._dynamics import Dynamic, Dynamics, DynamicsConfig
from refu_core.backbones._gcnn import Gcnn, GcnnConfig
from refu_core.backbones._mlp import Mlp, MlpConfig
from refu_core.backbones._protocol import MAX_OFFSET, Backbone, Skinned
from refu_core.backbones._tailornet import TailorNet, TailorNetConfig
from refu_core.errors import WeightsError
from refu_core.frames import N_BETAS, N_JOINTS
from refu_core.garments import GarmentTemplate, load_garment
from refu_core.modes import BackboneName, SdfMode
from refu_core.weights import (
    Weights,
    build_for,
    config_of_card,
    load_card,
    load_weights,
    naming,
    save_weights,
    weights_folder,
)

PRESETS: tuple[str, ...] = ("realtime", "paper")
"""`realtime` has low-rank heads and sizes for a CPU, `paper` the sizes of the paper."""

BackboneConfig = TailorNetConfig | MlpConfig | GcnnConfig
Network = TailorNet | Mlp | Gcnn
"""A backbone that is trained."""
_CONFIGS: dict[str, type[BackboneConfig]] = {"tailornet": TailorNetConfig, "mlp": MlpConfig, "gcnn": GcnnConfig}
TRAINABLE: tuple[str, ...] = tuple(_CONFIGS)
"""Backbones that have weights."""


def backbone_config(name: str, garment: GarmentTemplate, *, preset: str = "realtime") -> BackboneConfig:
    """The configuration of the backbone `name` for a garment. Raises `WeightsError` for no such name or preset."""
    if name not in _CONFIGS:
        raise WeightsError(f"no backbone {name!r} that could be trained: wanted {', '.join(TRAINABLE)}")
    if preset not in PRESETS:
        raise WeightsError(f"no preset {preset!r}: wanted {' or '.join(PRESETS)}")
    config, joints = _CONFIGS[name], garment.card.joints
    return config.paper(joints) if preset == "paper" else config(joints)


def uses_basis(config: BackboneConfig, preset: str) -> bool:
    """Whether the backbone's head is low-rank, that is needs an output basis."""
    return preset == "realtime" and not isinstance(config, GcnnConfig)


def build_backbone(
    config: BackboneConfig, garment: GarmentTemplate, *, basis: BasisDecoder | None = None, pivots: Tensor | None = None
) -> Network:
    """An untrained backbone for a garment.

    Heads are low-rank with an output basis, dense without one; the gcnn has no head. A tailornet needs the (β, γ) of
    its pivots, shape (K, 14), and raises `WeightsError` without.
    """
    if isinstance(config, GcnnConfig):
        return Gcnn(config, garment)
    decoder: Decoder = basis if basis is not None else DenseDecoder(garment.n_vertices)
    if isinstance(config, MlpConfig):
        return Mlp(config, decoder)
    if pivots is None:
        raise WeightsError("a tailornet needs pivots: (β, γ) of the style-shape pairs of its high-frequency nets")
    return TailorNet(config, garment, decoder, pivots)


_PREFIX = "backbone."


def save_basis(folder: Path, basis: BasisDecoder, card: Mapping[str, Any]) -> Path:
    """Writes the output basis of a garment, `folder`/basis. Raises `WeightsError` where that can't be done."""
    return save_weights(folder / "basis", basis.tensors(), {**card, "rank": basis.size})


def require_basis(folder: Path, digest: str | None, *, written: Sequence[str]) -> None:
    """Raises `WeightsError` if a new basis would replace that of weights in the folder that aren't `written` anew.

    The new basis has this `digest`; None for one that no weights in the folder were trained with.
    """
    for path in sorted(folder.glob("*.json")):
        if path.stem in (*written, "basis"):
            continue
        card = read_json(path, error=WeightsError, wanted="the card of weights")
        known = card.get("basis_sha256", digest) if isinstance(card, dict) else digest
        if known != digest:
            msg = f"{path}: was trained with another basis than what would be written beside it; use a new folder"
            raise WeightsError(msg)


def load_basis(folder: Path, garment: GarmentTemplate, *, expect: Mapping[str, Any]) -> tuple[BasisDecoder, str]:
    """The output basis of a garment and its hash. Raises `WeightsError` as `refu_core.weights.load_weights` does."""
    weights = load_weights(folder / "basis", expect=expect)
    with naming(weights.path):
        basis = BasisDecoder.of_tensors(weights.tensors, garment)
    return basis, str(weights.card["sha256"])


def save_backbone(
    stem: Path,
    backbone: Network,
    card: Mapping[str, Any],
    *,
    others: Mapping[str, Tensor] | None = None,
    exact: bool = False,
) -> Path:
    """Writes a backbone, without its basis, and its card: `stem` with suffixes; the basis lies in the same folder.

    The card says `garment`, `body_fingerprint`, and whatever else is known. `others` are tensors that belong with it,
    the ReFU layer's for instance, with another prefix. Unless `exact`, what was learnt is stored in fewer bytes.

    Raises `WeightsError` for weights that aren't finite or can't be written, and for another basis in the folder.
    """
    tensors, in_bytes = _own_tensors(backbone, exact=exact)
    name = next(name for name, kind in _CONFIGS.items() if isinstance(backbone.config, kind))
    described: dict[str, Any] = {"backbone": name, "config": asdict(backbone.config)}
    if not isinstance(backbone, Gcnn) and isinstance(backbone.decoder, BasisDecoder):
        basis = load_weights(stem.parent / "basis", expect={"garment": card["garment"]})
        described["basis_sha256"] = str(basis.card["sha256"])
        if not backbone.decoder.is_stored_as(basis.tensors):
            msg = f"{stem}: the basis in this folder isn't the one that the backbone was trained with; use a new folder"
            raise WeightsError(msg)
    stored = {_PREFIX + k: v for k, v in tensors.items()} | dict(others or {})
    return save_weights(stem, stored, {**described, **card}, in_bytes=[_PREFIX + k for k in in_bytes])


def backbone_from_weights(weights: Weights, garment: GarmentTemplate, *, device: str | torch.device = "cpu") -> Network:
    """The backbone in `weights`, with the basis beside them, in float32 and ready for use (`eval`).

    Raises `WeightsError`: they are for another version or garment, or their basis is missing, damaged or replaced.
    """
    card, template = weights.card, garment.to(device="cpu")
    name = str(card.get("backbone"))
    with naming(weights.path):
        if name not in _CONFIGS:
            raise WeightsError(f"a card of a backbone {name[:80]!r} that this version doesn't know; train it again")
        config = config_of_card(_CONFIGS[name], card.get("config"))
    basis = None
    if "basis_sha256" in card:
        identity = {key: card[key] for key in ("garment", "body_fingerprint") if key in card}
        basis, digest = load_basis(weights.path.parent, template, expect=identity)
        if digest != card["basis_sha256"]:
            raise WeightsError(f"{weights.path}: made for another basis than the one beside it; get both files again")
    tensors = {k[len(_PREFIX) :]: v for k, v in weights.tensors.items() if k.startswith(_PREFIX)}
    build = partial(build_backbone, config, template, basis=basis, pivots=tensors.get("pivots"))
    with naming(f"{weights.path}: doesn't fit {garment.name}"):
        module = build_for(tensors, build, shared="decoder.")
    module = module.to(device).eval()
    with torch.no_grad():
        at_rest = module(memory(1, N_BETAS, device=device), memory(1, N_JOINTS, 3, device=device), None)
    offset = float(at_rest.abs().max())
    if not offset <= MAX_OFFSET:  # also refuses NaN
        msg = f"{weights.path}: wanted a garment within {MAX_OFFSET:g} m of a body at rest, this one is "
        msg += f"{offset:.3g} m off; train it again"
        raise WeightsError(msg)
    return module


def save_dynamics(folder: Path, dynamics: Dynamics, card: Mapping[str, Any]) -> Path:
    """Writes a garment's dynamics, `folder`/dynamics. Raises `WeightsError` also if there is no basis."""
    return _save_addition(folder / "dynamics", dynamics, card, {})


def save_carried_dynamics(folder: Path, like: str, codes: Tensor, card: Mapping[str, Any]) -> Path | None:
    """Writes `folder`/dynamics: those of the garment `like`, as they ship, with codes turned by `codes` (C, C').

    None if `like` has none of its own. Raises `WeightsError` also if there is no basis in the folder.
    """
    stem = weights_folder(like) / "dynamics"
    related = load_card(stem) if Path(f"{stem}.json").exists() else {"like": None}
    if "like" in related:
        return None
    described = {"like": like, "like_sha256": related.get("sha256")}
    return _save_beside(folder / "dynamics", {**described, **card}, {_CODES: codes}, [_CODES])


def with_dynamics(name: str, network: Backbone, weights: Weights) -> Backbone:
    """The backbone `name`: the `network` made from `weights`, with the dynamics beside them if it wants those.

    Raises `WeightsError`: the network isn't a tailornet, or the dynamics are missing, damaged, or made for another
    basis.
    """
    there = weights.path.with_name("dynamics.json").exists()
    if name != BackboneName.DYNAMIC and not (name == BackboneName.AUTO and there):
        return network
    if not isinstance(network, TailorNet):
        raise WeightsError(f"{weights.path}: dynamics go with a tailornet, got {weights.card.get('backbone')}")
    stored = _load_beside(weights, "dynamics")
    with naming(stored.path):
        dynamics = _carried(stored, network) if "like" in stored.card else _own(stored, network, weights.path.name)
    dynamics = dynamics.to(next(network.parameters()).device)
    return Dynamic(network, dynamics).eval().requires_grad_(False)


def _own(stored: Weights, network: TailorNet, of: str) -> Dynamics:
    """What `save_dynamics` wrote, for a `network` from the file `of`."""
    config = config_of_card(DynamicsConfig, stored.card.get("config"))
    if not set(config.joints) <= {0, *network.config.joints}:
        msg = f"wanted joints below {N_JOINTS} that the tailornet knows ({network.config.joints}), got {config.joints}"
        raise WeightsError(f"{msg}; train it again")
    with naming(f"doesn't fit {of}"):
        return build_for(stored.tensors, lambda: Dynamics(config, network))


def _carried(stored: Weights, network: TailorNet) -> Dynamics:
    """What `save_carried_dynamics` wrote."""
    like = stored.card["like"]
    if not isinstance(like, str) or like != Path(like).name:
        raise WeightsError(f"wanted the name of a related garment, got {str(like)[:80]!r}; carry them over anew")
    if load_card(weights_folder(like) / "dynamics").get("sha256") != stored.card.get("like_sha256"):
        raise WeightsError(f"made from other dynamics of {like} than those that ship; carry them over anew")
    return carried_dynamics(like, stored.tensors.get(_CODES, torch.zeros(0)), network)


def carried_dynamics(like: str, codes: Tensor, network: TailorNet) -> Dynamics:
    """The dynamics that ship for the garment `like`, with codes (C',) turned into the network's by `codes` (C, C').

    Of joints that the network isn't told of, they hear how these have moved, but not where they are: the mean stands
    for that. Raises `WeightsError`: none ship that are the garment's own, or their codes have another size.
    """
    related = load_weights(weights_folder(like) / "dynamics")
    config = config_of_card(DynamicsConfig, related.card.get("config"))
    first, last = "net.layers.0.weight", f"net.layers.{len(config.hidden)}."
    if codes.ndim != 2 or {codes.shape[1]} != {len(v) for name, v in related.tensors.items() if name.startswith(last)}:
        raise WeightsError(f"wanted a matrix for codes of {like}, got {tuple(codes.shape)}; carry them over anew")
    is_known = torch.ones(related.tensors[first].shape[1], dtype=torch.bool)
    for k, joint in enumerate(joint for joint in config.joints if joint != 0):
        is_known[3 + 9 * k : 12 + 9 * k] = joint in network.features.joints
    tensors = {}
    for name, tensor in related.tensors.items():
        heard = tensor[..., is_known] if name == first or tensor.shape == is_known.shape else tensor
        tensors[name] = codes @ heard.float() if name.startswith(last) else heard
    return build_for(tensors, lambda: Dynamics(config, network))


_CODES = "codes"
_BASIS = "basis."


def save_beyond(folder: Path, beyond: Beyond, card: Mapping[str, Any]) -> Path:
    """Writes what is added in postures of a kind, `folder`/<kind>. Raises `WeightsError` also if there is no basis."""
    basis = {_BASIS + k: v for k, v in beyond.decoder.tensors().items()}
    return _save_addition(folder / beyond.kind, beyond, card, basis)


def _save_addition(
    stem: Path, network: Dynamics | Beyond, card: Mapping[str, Any], others: Mapping[str, Tensor]
) -> Path:
    tensors, in_bytes = _own_tensors(network)
    return _save_beside(stem, {"config": asdict(network.config), **card}, {**tensors, **others}, in_bytes)


def _save_beside(stem: Path, card: Mapping[str, Any], tensors: Mapping[str, Tensor], in_bytes: Sequence[str]) -> Path:
    """Writes what is added to a backbone, beside it; its card names the backbone's basis."""
    basis = load_weights(stem.parent / "basis", expect={"garment": card["garment"]})
    return save_weights(stem, tensors, {"basis_sha256": str(basis.card["sha256"]), **card}, in_bytes=in_bytes)


def _load_beside(weights: Weights, name: str) -> Weights:
    """What `_save_beside` wrote as `name` beside a tailornet's `weights`."""
    expect = {key: weights.card.get(key) for key in ("garment", "body_fingerprint", "basis_sha256")}
    return load_weights(weights.path.with_name(name), expect=expect)


def _own_tensors(network: Module, *, exact: bool = False) -> tuple[dict[str, Tensor], list[str]]:
    """A network's tensors without its decoder's, and the names of those that are to be stored in bytes.

    Unless `exact`, these are its matrices; other parameters are in half precision. This moves a garment by 0.11 mm on
    recorded motion, 1 mm at most; the networks are off by 8 mm.
    """
    learnt = dict(network.named_parameters())
    state = {k: v for k, v in network.state_dict().items() if not k.startswith("decoder.")}
    if exact:
        return state, []
    # Buffers (pivots, standardisation) stay exact: the kernel of the mixture is narrow.
    short = {k: v.half() if k in learnt and v.ndim < 2 else v for k, v in state.items()}
    return short, [k for k in state if k in learnt and learnt[k].ndim > 1]


def with_beyond(network: Backbone, weights: Weights, garment: GarmentTemplate) -> Backbone:
    """A garment's backbone made from `weights`, with the networks for further postures that are beside a tailornet's.

    Raises `WeightsError`: one is damaged, or made for another basis.
    """
    kinds = [kind for kind in KINDS if weights.path.with_name(f"{kind}.json").exists()]
    if weights.card.get("backbone") != "tailornet" or not kinds:
        return network
    device = next(network.parameters()).device if isinstance(network, Module) else "cpu"
    beyond = [load_beyond(kind, weights, garment).to(device) for kind in kinds]
    return WithBeyond(network, beyond).eval().requires_grad_(False)


def load_beyond(kind: str, weights: Weights, garment: GarmentTemplate) -> Beyond:
    """A garment's network of a kind that is beside a tailornet's `weights`. Raises `WeightsError` as `with_beyond`."""
    stored = _load_beside(weights, kind)
    tensors = {k: v for k, v in stored.tensors.items() if not k.startswith(_BASIS)}
    with naming(stored.path):
        config = config_of_card(BeyondConfig, stored.card.get("config"))
        basis = {k[len(_BASIS) :]: v for k, v in stored.tensors.items() if k not in tensors}
        decoder = BasisDecoder.of_tensors(basis, garment)
        if decoder.n_vertices != garment.n_vertices:
            raise WeightsError(f"wanted {garment.n_vertices} vertices, got {decoder.n_vertices}; train it again")
        return build_for(tensors, lambda: Beyond(kind, config, decoder), shared="decoder.")


def load_backbone(
    name: str, garment: str | GarmentTemplate, *, mode: str = "none", folder: Path | None = None
) -> Backbone:
    """The trained backbone `name` of a garment: `skinned`, `tailornet`, `dynamic`, `mlp`, `gcnn`, or `auto`.

    `auto` is `dynamic` or `tailornet` where it ships, else `skinned`. `mode` is what it was trained with: `none`,
    `approx`, `accurate` or `hybrid`; `folder` is where its files lie, by default the shipped weights.

    Raises `GarmentError` for no such garment, and `WeightsError` for no such backbone or mode, or no weights of it.
    """
    template = load_garment(garment) if isinstance(garment, str) else garment
    weights = backbone_weights(name, template.name, mode=mode, folder=folder)
    if weights is None:
        return Skinned()
    network = backbone_from_weights(weights, template).requires_grad_(False)
    return with_beyond(with_dynamics(name, network, weights), weights, template)


def backbone_weights(name: str, garment: str, *, mode: str, folder: Path | None = None) -> Weights | None:
    """The weights that `load_backbone` uses; None for `skinned`, and for `auto` if none ship. Raises as it does."""
    stem = backbone_stem(name, garment, mode=mode, folder=folder)
    return None if stem is None else load_weights(stem, expect={"garment": garment})


def backbone_stem(name: str, garment: str, *, mode: str, folder: Path | None = None) -> Path | None:
    """The path of those weights without a suffix, or None; they aren't opened.

    Raises `WeightsError` for no such backbone or mode.
    """
    kind = BackboneName.of(name, "backbone", error=WeightsError)
    mode = SdfMode.of(mode, "mode of a backbone", error=WeightsError)
    shipped = weights_folder(garment)
    folder = shipped if folder is None else folder
    nothing_ships = folder == shipped and not shipped.exists()  # in a folder that was named there must be some
    if kind is BackboneName.SKINNED or (kind is BackboneName.AUTO and nothing_ships):
        return None
    if kind in (BackboneName.AUTO, BackboneName.DYNAMIC):  # `dynamic` is a tailornet, and more
        kind = BackboneName.TAILORNET
    return folder / f"{kind}-{mode}"
