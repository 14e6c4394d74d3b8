"""Backbones by name and preset, untrained."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from torch import Tensor, nn

from refu_core.backbones._decoder import BasisDecoder, Decoder, DenseDecoder
from refu_core.backbones._gcnn import Gcnn, GcnnConfig
from refu_core.backbones._mlp import Mlp, MlpConfig
from refu_core.backbones._tailornet import TailorNet, TailorNetConfig
from refu_core.errors import WeightsError
from refu_core.garments import GarmentTemplate
from refu_core.weights import config_of_card

PRESETS: tuple[str, ...] = ("realtime", "paper")
"""`realtime` has low-rank heads and sizes for a CPU, `paper` the sizes of the paper."""

_CONFIGS: dict[str, type[TailorNetConfig] | type[MlpConfig] | type[GcnnConfig]] = {
    "tailornet": TailorNetConfig,
    "mlp": MlpConfig,
    "gcnn": GcnnConfig,
}
TRAINABLE: tuple[str, ...] = tuple(_CONFIGS)
"""Backbones that have weights."""

BackboneConfig = TailorNetConfig | MlpConfig | GcnnConfig
Network = TailorNet | Mlp | Gcnn
"""A backbone that is trained."""


def backbone_config(name: str, garment: GarmentTemplate, *, preset: str = "realtime") -> BackboneConfig:
    """The configuration of the backbone `name` for a garment.

    Raises:
        WeightsError: no such backbone, or no such preset.
    """
    if name not in _CONFIGS:
        msg = f"no backbone {name!r} that could be trained: wanted {', '.join(TRAINABLE)}"
        raise WeightsError(msg)
    if preset not in PRESETS:
        msg = f"no preset {preset!r}: wanted {' or '.join(PRESETS)}"
        raise WeightsError(msg)
    config, joints = _CONFIGS[name], garment.card.joints
    return config.paper(joints) if preset == "paper" else config(joints)


def uses_basis(config: BackboneConfig, preset: str) -> bool:
    """Whether the backbone's head is low-rank, that is needs an output basis."""
    return preset == "realtime" and not isinstance(config, GcnnConfig)


def build_backbone(
    config: BackboneConfig,
    garment: GarmentTemplate,
    *,
    basis: BasisDecoder | None = None,
    pivots: Tensor | None = None,
) -> Network:
    """An untrained backbone.

    Args:
        config: from `backbone_config`, or one's own.
        garment: the template that it is for.
        basis: output basis of low-rank heads; dense heads without one. The gcnn has no head and takes none.
        pivots: (β, γ) of the pivots of a tailornet, shape (K, 14).

    Raises:
        WeightsError: a tailornet without pivots.
    """
    if isinstance(config, GcnnConfig):
        return Gcnn(config, garment)
    decoder: Decoder = basis if basis is not None else DenseDecoder(garment.n_vertices)
    if isinstance(config, MlpConfig):
        return Mlp(config, decoder)
    if pivots is None:
        msg = "a tailornet needs pivots: (β, γ) of the style-shape pairs of its high-frequency nets"
        raise WeightsError(msg)
    return TailorNet(config, garment, decoder, pivots)


def backbone_name(module: nn.Module) -> str:
    """The name of a backbone."""
    names: Mapping[type[nn.Module], str] = {TailorNet: "tailornet", Mlp: "mlp", Gcnn: "gcnn"}
    return names[type(module)]


def config_to_card(config: BackboneConfig) -> dict[str, Any]:
    """What a card says of a configuration."""
    return asdict(config)


def config_from_card(name: str, values: Mapping[str, Any]) -> BackboneConfig:
    """The inverse of `config_to_card`.

    Raises:
        WeightsError: the card doesn't describe such a backbone.
    """
    if name not in _CONFIGS:
        msg = f"a card of a backbone {name[:80]!r} that this version doesn't know; train it again"
        raise WeightsError(msg)
    return config_of_card(_CONFIGS[name], values)
