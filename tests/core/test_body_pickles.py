"""Models as pickles: read as data, whatever made them, and never executed."""

from __future__ import annotations

import contextlib
import io
import os
import pickle
import subprocess
import sys
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.sparse
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from refu_core import BodyError, load_body
from tests.core.test_body import model, random_model


def official_pickle(data: dict[str, NDArray[np.float64]]) -> bytes:
    """A pickle built as the official files are: protocol 2, chumpy variables, a sparse joint regressor."""

    class Ch:
        def __init__(self, x: NDArray[np.float64]) -> None:
            self.x = x

    chumpy, module = types.ModuleType("chumpy"), types.ModuleType("chumpy.ch")
    Ch.__module__, Ch.__qualname__ = "chumpy.ch", "Ch"
    module.Ch = Ch  # type: ignore[attr-defined]
    sys.modules.update({"chumpy": chumpy, "chumpy.ch": module})
    try:
        content = dict(data)
        content["v_template"] = Ch(data["v_template"])  # type: ignore[assignment]
        content["shapedirs"] = Ch(np.asfortranarray(data["shapedirs"]))  # type: ignore[assignment]
        content["J_regressor"] = scipy.sparse.csc_matrix(data["J_regressor"])
        content["bs_style"] = "lbs"  # type: ignore[assignment]
        return pickle.dumps(content, protocol=2)
    finally:
        del sys.modules["chumpy"], sys.modules["chumpy.ch"]


def test_loads_an_official_pickle_without_chumpy(tmp_path: Path) -> None:
    data = random_model(np.random.default_rng(6))
    (tmp_path / "model.pkl").write_bytes(official_pickle(data))
    assert "chumpy" not in sys.modules
    body = load_body(tmp_path / "model.pkl", dtype=torch.float64)
    pose = np.random.default_rng(7).normal(size=(1, 24, 3))
    torch.testing.assert_close(body(pose).vertices, model(data)(pose).vertices)


KINDS = ("csc_matrix", "csr_matrix", "coo_matrix", "csc_array", "csr_array", "coo_array")


@pytest.mark.parametrize("protocol", [0, 2, 5])
def test_sparse_matrices_and_tensors_are_read(tmp_path: Path, protocol: int) -> None:
    data = random_model(np.random.default_rng(6))
    wanted = model(data).fingerprint
    regressor = data["J_regressor"]
    kept: list[Any] = [getattr(scipy.sparse, kind)(regressor) for kind in KINDS]
    twice = scipy.sparse.coo_matrix(regressor)
    twice.data, twice.row, twice.col = (np.tile(a, 2) for a in (twice.data / 2, twice.row, twice.col))
    old = scipy.sparse.coo_matrix(regressor)  # as SciPy kept it before its version 1.13
    old.__dict__.update(row=old.row, col=old.col)
    old.__dict__.pop("coords", None)
    for value in (*kept, twice, old, torch.as_tensor(regressor)):
        (tmp_path / "model.pkl").write_bytes(pickle.dumps({**data, "J_regressor": value}, protocol))
        assert load_body(tmp_path / "model.pkl").fingerprint == wanted, type(value)


def test_what_a_model_does_not_need_may_be_of_any_kind(tmp_path: Path) -> None:
    """It stays inert; what it does need may not, and the message says how to save it."""
    data, marker = random_model(np.random.default_rng(6)), tmp_path / "marker"
    rows = scipy.sparse.lil_matrix(data["J_regressor"])
    more = {"prior": rows, "by": types.SimpleNamespace(a=1), "evil": Evil(os.system, f"touch {marker}")}
    (tmp_path / "model.pkl").write_bytes(pickle.dumps(data | more))
    assert load_body(tmp_path / "model.pkl").fingerprint == model(data).fingerprint
    assert not marker.exists()
    for value, saved in (
        (rows, r"lil_matrix.*save what its toarray\(\) gives"),
        (more["by"], "save a plain NumPy array"),
    ):
        (tmp_path / "model.pkl").write_bytes(pickle.dumps(data | {"J_regressor": value}))
        with pytest.raises(BodyError, match=f"J_regressor can't be read: it refers to .*{saved}"):
            load_body(tmp_path / "model.pkl")
    np.savez(tmp_path / "model.npz", **data | {"J_regressor": scipy.sparse.csr_matrix(data["J_regressor"])})
    with pytest.raises(BodyError, match=r"J_regressor: an array of objects.*what its toarray\(\) gives"):
        load_body(tmp_path / "model.npz")


def test_what_torch_writes_and_isnt_read_is_named(tmp_path: Path) -> None:
    data, path = random_model(np.random.default_rng(6)), tmp_path / "model.pkl"
    path.write_bytes(pickle.dumps(data | {"weights": torch.as_tensor(data["weights"]).bfloat16()}))
    with pytest.raises(BodyError, match=r"weights can't be read: .* as bfloat16: save it as float32"):
        load_body(path)
    torch.save(data, path)
    with pytest.raises(BodyError, match=r"torch.save writes it.* by numpy.savez"):
        load_body(path)


@given(data=st.data(), kind=st.sampled_from(("csr", "coo")))
def test_damaged_sparse_matrices_raise_body_errors_only(
    data: st.DataObject, kind: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    arrays = random_model(np.random.default_rng(8), 30)
    matrix = getattr(scipy.sparse, f"{kind}_matrix")(arrays["J_regressor"])
    names = ("data", "indices", "indptr") if kind == "csr" else ("data", "row", "col")
    name = data.draw(st.sampled_from(names))
    part = getattr(matrix, name).copy()
    part[data.draw(st.integers(0, len(part) - 1))] = data.draw(st.integers(-(2**31), 2**31 - 1))
    part = part[: data.draw(st.integers(0, len(part)))] if data.draw(st.booleans()) else part
    state = {"_shape": data.draw(st.sampled_from([(24, 30), (30, 24), (24, 1), (-1, 30), (2**40, 2**40)]))}
    state |= {key: getattr(matrix, key) for key in names} | {name: part}
    matrix.__dict__.clear()
    matrix.__dict__.update(state)
    path = tmp_path_factory.mktemp("damaged") / "model.pkl"
    path.write_bytes(pickle.dumps(arrays | {"J_regressor": matrix}))
    with contextlib.suppress(BodyError):
        load_body(path)


class Evil:
    def __init__(self, function: object, *arguments: object) -> None:
        self._call = (function, arguments)

    def __reduce__(self) -> tuple[object, tuple[object, ...]]:
        return self._call


@pytest.mark.parametrize(
    ("function", "arguments", "named"),
    [
        (os.system, ("touch {marker}",), r"(posix|nt)\.system"),
        (subprocess.check_call, (["touch", "{marker}"],), r"(subprocess|commands)\.check_call"),
        (eval, ("open({marker!r}, 'w')",), "builtins.eval|__builtin__.eval"),
        (np.load, ("{marker}",), "numpy.*load"),
        (io.open, ("{marker}", "w"), "open"),
        (getattr, (np, "load"), "getattr"),
    ],
)
@pytest.mark.parametrize("protocol", [0, 2, 5])
def test_a_pickle_that_executes_code_is_refused(
    tmp_path: Path, function: object, arguments: tuple[object, ...], named: str, protocol: int
) -> None:
    marker = tmp_path / "marker"

    def fill(value: object) -> object:
        if isinstance(value, list):
            return [fill(item) for item in value]
        return value.format(marker=str(marker)) if isinstance(value, str) and "{marker" in value else value

    if function is getattr:
        arguments = ("text", "upper")
    content = {"v_template": Evil(function, *(fill(a) for a in arguments))}
    (tmp_path / "evil.pkl").write_bytes(pickle.dumps(content, protocol=protocol))
    with pytest.raises(BodyError, match=f"(?:{named}).*nothing was executed"):
        load_body(tmp_path / "evil.pkl")
    assert not marker.exists()


@given(data=st.data())
def test_damaged_pickles_raise_body_errors_only(data: st.DataObject, tmp_path_factory: pytest.TempPathFactory) -> None:
    good = bytearray(official_pickle(random_model(np.random.default_rng(8), 30)))
    for _ in range(data.draw(st.integers(1, 4))):
        good[data.draw(st.integers(0, len(good) - 1))] = data.draw(st.integers(0, 255))
    cut = data.draw(st.integers(0, len(good)))
    path = tmp_path_factory.mktemp("damaged") / "model.pkl"
    path.write_bytes(bytes(good[:cut]) if data.draw(st.booleans()) else bytes(good))
    with contextlib.suppress(BodyError):  # some damage leaves a model; anything but a BodyError fails the test
        load_body(path)
