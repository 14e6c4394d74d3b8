"""Backbones by name and preset, untrained."""

from __future__ import annotations

from typing import Any

from torch import Tensor

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


def backbone_name(config: BackboneConfig) -> str:
    """The name of the backbone that has this configuration."""
    return next(name for name, kind in _CONFIGS.items() if isinstance(config, kind))


def config_from_card(name: str, values: Any) -> BackboneConfig:
    """The configuration that a card has as `values`. Raises `WeightsError` unless it fits the backbone `name`."""
    if name not in _CONFIGS:
        raise WeightsError(f"a card of a backbone {name[:80]!r} that this version doesn't know; train it again")
    return config_of_card(_CONFIGS[name], values)
