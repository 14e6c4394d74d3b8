"""Weights are what was written, or one clear error."""

from __future__ import annotations

import hashlib
import json
from importlib import metadata
from pathlib import Path

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from refu_core import __version__
from refu_core._versions import versions
from refu_core.errors import WeightsError
from refu_core.garments import PAPER_GARMENTS
from refu_core.weights import load_weights, save_weights, weights_folder

TENSORS = {"low.0.weight": torch.arange(6.0).view(2, 3), "basis": torch.randn(4, 5).half(), "mask": torch.tensor([1])}
CARD = {"garment": "tshirt-male", "body_fingerprint": "abc", "mode": "hybrid"}


@pytest.fixture
def stem(tmp_path: Path) -> Path:
    stem = tmp_path / "weights" / "tailornet-hybrid.v2"  # a dot in the name is no suffix
    save_weights(stem, TENSORS, CARD)
    return stem


def test_a_card_is_written_without_installation() -> None:
    """A source tree on the path has no metadata, which mustn't cost a training its weights."""
    assert versions("torch", "no-such-distribution") == {
        "refu-ros": __version__,
        "torch": metadata.version("torch"),  # torch.__version__ also names the CUDA that it was built for
        "no-such-distribution": "not installed",
    }


def test_what_was_saved_is_loaded(stem: Path) -> None:
    weights = load_weights(stem, expect={"garment": "tshirt-male", "body_fingerprint": "abc"})
    assert weights.tensors.keys() == TENSORS.keys()
    for name, tensor in TENSORS.items():
        assert weights.tensors[name].dtype == tensor.dtype
        assert torch.equal(weights.tensors[name], tensor)
    assert weights.card.items() >= CARD.items()
    assert "torch" in weights.card["versions"]


def test_nothing_else_is_left_in_the_folder(stem: Path) -> None:
    save_weights(stem, TENSORS, CARD)
    assert sorted(p.name for p in stem.parent.iterdir()) == [f"{stem.name}.json", f"{stem.name}.safetensors"]


def test_weights_of_another_body_are_refused_with_what_to_do(stem: Path) -> None:
    with pytest.raises(WeightsError, match=r"body_fingerprint is other, got abc; train some with `refu train`"):
        load_weights(stem, expect={"body_fingerprint": "other"})


def test_missing_weights(tmp_path: Path) -> None:
    with pytest.raises(WeightsError, match="no such weights"):
        load_weights(tmp_path / "none")


def test_weights_and_card_must_belong_together(stem: Path) -> None:
    other = stem.with_name("other")
    save_weights(other, {"a": torch.zeros(2)}, CARD)
    (stem.parent / f"{other.name}.safetensors").replace(stem.parent / f"{stem.name}.safetensors")
    with pytest.raises(WeightsError, match="damaged, or not the file"):
        load_weights(stem)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_weights_that_are_not_finite_are_never_written(stem: Path, value: float) -> None:
    before = (stem.parent / f"{stem.name}.safetensors").read_bytes()
    with pytest.raises(WeightsError, match="NaN or infinity in b"):
        save_weights(stem, {"a": torch.zeros(1), "b": torch.tensor([value])}, CARD)
    assert (stem.parent / f"{stem.name}.safetensors").read_bytes() == before


def test_a_disk_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(WeightsError, match="can't be written"):
        save_weights(tmp_path / "file" / "weights", TENSORS, CARD)


@pytest.mark.parametrize("card", ["", "[1]", '{"format": "other"}', "[" * 100_000, "\x00"])
def test_cards_of_another_kind(stem: Path, card: str) -> None:
    (stem.parent / f"{stem.name}.json").write_text(card)
    with pytest.raises(WeightsError, match="card"):
        load_weights(stem)


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
@given(cut=st.integers(0, 400), flip=st.integers(0, 10_000), bit=st.integers(0, 7))
def test_damaged_bytes_never_pass(stem: Path, cut: int, flip: int, bit: int) -> None:
    path = stem.parent / f"{stem.name}.safetensors"
    good = path.read_bytes()
    data = bytearray(good[: max(1, len(good) - cut)])
    if cut == 0:
        data[flip % len(data)] ^= 1 << bit
    try:
        path.write_bytes(bytes(data))
        with pytest.raises(WeightsError):
            load_weights(stem)
    finally:
        path.write_bytes(good)


def test_a_forged_sum_does_not_help_a_broken_file(stem: Path) -> None:
    data = b"\xff" * 64
    card = json.loads((stem.parent / f"{stem.name}.json").read_text())
    (stem.parent / f"{stem.name}.safetensors").write_bytes(data)
    (stem.parent / f"{stem.name}.json").write_text(json.dumps(card | {"sha256": hashlib.sha256(data).hexdigest()}))
    with pytest.raises(WeightsError, match="not a safetensors file"):
        load_weights(stem)


# Weights stored as differences from others


@pytest.fixture
def base(tmp_path: Path) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    tensors = {"w": torch.randn(40, 30, generator=generator).half(), "b": torch.randn(30, generator=generator).half()}
    save_weights(tmp_path / "base", {**tensors, "pivots": torch.arange(3.0)}, CARD)
    return tensors


def test_differences_are_read_as_the_weights(tmp_path: Path, base: dict[str, torch.Tensor]) -> None:
    fine = torch.randn(40, 30, generator=torch.Generator().manual_seed(1)) * 0.01
    own = {"w": base["w"].float() + fine, "b": base["b"], "more": torch.ones(2)}
    path = save_weights(tmp_path / "other", own, CARD, base="base")
    read = load_weights(tmp_path / "other", expect=CARD)
    assert read.tensors.keys() == {"w", "b", "more", "pivots"}
    assert torch.equal(read.tensors["b"], base["b"])
    assert torch.equal(read.tensors["more"], torch.ones(2))
    assert torch.equal(read.tensors["pivots"], torch.arange(3.0))  # what isn't given is the base's
    torch.testing.assert_close(read.tensors["w"], own["w"], rtol=0, atol=0.51 * float(fine.abs().max()) / 127 + 1e-7)
    assert read.files == (tmp_path / "base.safetensors", path)
    assert path.stat().st_size < 0.8 * (tmp_path / "base.safetensors").stat().st_size


def test_differences_from_other_weights_are_refused(tmp_path: Path, base: dict[str, torch.Tensor]) -> None:
    save_weights(tmp_path / "other", {"w": base["w"] + 1}, CARD, base="base")
    with pytest.raises(WeightsError, match=r"wanted a base that is stored whole, got other; nothing was written"):
        save_weights(tmp_path / "chain", {"w": base["w"]}, CARD, base="other")
    digest = json.loads((tmp_path / "other.json").read_text())["sha256"]
    save_weights(tmp_path / "chain", {}, {**CARD, "base": "other", "base_sha256": digest})
    with pytest.raises(WeightsError, match=r"made for another other than the one beside it; get both files again"):
        load_weights(tmp_path / "chain")
    card = tmp_path / "other.json"
    good = card.read_text()
    for name in ("../base", "", "/etc/passwd", 3, ["base"]):
        card.write_text(json.dumps({**json.loads(good), "base": name}))
        with pytest.raises(WeightsError):
            load_weights(tmp_path / "other")
    card.write_text(good)
    save_weights(tmp_path / "base", {"w": base["w"] * 2}, CARD)
    with pytest.raises(WeightsError, match=r"made for another base than the one beside it; get both files again"):
        load_weights(tmp_path / "other")
    (tmp_path / "base.safetensors").unlink()
    with pytest.raises(WeightsError, match=r"base.safetensors: no such weights"):
        load_weights(tmp_path / "other")


@pytest.mark.parametrize(
    "tensors",
    [
        {"v": torch.ones(3, dtype=torch.int8), "v.step": torch.ones(())},
        {"b.step": torch.ones(())},
        {"b": torch.ones(2, dtype=torch.int8), "b.step": torch.ones(())},
        {"b": torch.ones(30), "b.step": torch.ones(())},
        {"b": torch.ones(30, dtype=torch.int8), "b.step": torch.ones(30)},
    ],
)
def test_what_is_no_difference_is_refused(
    tmp_path: Path, base: dict[str, torch.Tensor], tensors: dict[str, torch.Tensor]
) -> None:
    assert base
    digest = json.loads((tmp_path / "base.json").read_text())["sha256"]
    save_weights(tmp_path / "other", tensors, {**CARD, "base": "base", "base_sha256": digest})
    with pytest.raises(WeightsError, match=r"isn't a difference from a tensor of base.safetensors"):
        load_weights(tmp_path / "other")


@pytest.mark.parametrize("shape", [(40, 30), (3, 40, 30)])
@pytest.mark.parametrize("scale", [1e-6, 1.0, 50.0])
def test_bytes_are_off_by_half_a_step_and_stay_the_same(tmp_path: Path, shape: tuple[int, ...], scale: float) -> None:
    w = scale * torch.randn(shape, generator=torch.Generator().manual_seed(2))
    w[0, 0] = 0
    path = save_weights(tmp_path / "first", {"w": w, "b": torch.ones(3)}, CARD, in_bytes=["w"])
    read = load_weights(tmp_path / "first")
    assert read.tensors.keys() == {"w", "b"}
    assert ((read.tensors["w"] - w).abs() <= w.abs().amax(1, keepdim=True) / 127 * 0.51).all()
    again = save_weights(tmp_path / "second", read.tensors, CARD, in_bytes=["w"])
    assert path.read_bytes() == again.read_bytes()
    save_weights(tmp_path / "other", {"w": w + 0.01 * scale}, CARD, base="first")
    torch.testing.assert_close(
        load_weights(tmp_path / "other").tensors["w"], w + 0.01 * scale, rtol=0, atol=1e-3 * scale
    )


@pytest.mark.parametrize(
    "tensors",
    [
        {"w.step": torch.ones(())},
        {"w": torch.ones(4, 3), "w.step": torch.ones(())},
        {"w": torch.ones(4, 3, dtype=torch.int8), "w.step": torch.ones(4)},
        {"w": torch.ones(4, 3, dtype=torch.int8), "w.step": torch.ones(3, 1)},
        {"w": torch.ones(4, 3, dtype=torch.int8), "w.step": torch.ones(4, 3)},
        {"w": torch.ones(4, dtype=torch.int8), "w.step": torch.ones(4, 1)},  # together they would be 4 x 4
    ],
)
def test_what_is_no_number_of_steps_is_refused(tmp_path: Path, tensors: dict[str, torch.Tensor]) -> None:
    save_weights(tmp_path / "w", tensors, CARD)
    with pytest.raises(WeightsError, match=r"w isn't a number of steps; get them again"):
        load_weights(tmp_path / "w")


def test_steps_cannot_hide_what_is_too_large(tmp_path: Path) -> None:
    save_weights(tmp_path / "w", {"w": torch.full((2, 2), 127, dtype=torch.int8), "w.step": torch.tensor(100.0)}, CARD)
    with pytest.raises(WeightsError, match=r"wanted weights of at most 10000, got larger ones in w"):
        load_weights(tmp_path / "w")


@pytest.mark.parametrize("garment", PAPER_GARMENTS)
def test_what_ships_shares_the_defaults_backbone_where_it_can(garment: str) -> None:
    """Fine-tuning brings a garment's networks to the same backbone by either distance."""
    folder = weights_folder(garment)
    hybrid = load_weights(folder / "tailornet-hybrid")
    for mode in ("approx", "accurate", "none"):
        weights = load_weights(folder / f"tailornet-{mode}", expect={"garment": garment, "base": "tailornet-hybrid"})
        same = all(torch.equal(t, hybrid.tensors[k]) for k, t in weights.tensors.items() if k.startswith("backbone."))
        assert same == weights.card["shares_backbone"] == (mode != "none")
        assert {"own_backbone", "hybrid_backbone"} == set(weights.card["measured"]["recorded motion"])
