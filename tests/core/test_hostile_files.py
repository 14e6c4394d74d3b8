"""Bodies and motions that were made to hang, crash or fill the memory of their readers."""

from __future__ import annotations

import gc
import io
import json
import os
import pickle
import pickletools
import struct
import zipfile
import zlib
from collections.abc import Callable
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from msg_adapters import read_motion
from refu_core import load_body
from refu_core._pickle_machine import NAMES
from refu_core.fitting import read_surface
from tests.core.test_body import random_model
from tests.core.test_files import SPECIAL
from tests.limits import refusal, run_limited, said

# Pickles ------------------------------------------------------------------------------------------

MODEL = random_model(np.random.default_rng(0), 30)
PAIRS = b"N" + b"2\x86" * 60
"""A tuple of 2⁶⁰ leaves, all shared: 120 bytes that take for ever to hash, compare or print."""
DEEP = b")" + b"\x85" * 90_000
"""A tuple that is nested as deeply as a C stack overflows from."""
CH, CSC, ARRAY = b"cchumpy.ch\nCh\n)\x81", b"cscipy.sparse.csc\ncsc_matrix\n)\x81", b"cnumpy\nndarray\n)\x81"
F8 = b"cnumpy\ndtype\n(U\x02f8K\x00K\x01tR"


def pkl(folder: Path, content: bytes) -> Path:
    path = folder / "model.pkl"
    path.write_bytes(content)
    return path


def array_of(shape: bytes, raw: bytes, dtype: bytes = F8) -> bytes:
    return ARRAY + b"(K\x01" + shape + dtype + b"I00\nB" + struct.pack("<I", len(raw)) + raw + b"tb"


def sparse(rows: bytes, columns: bytes, n_pointers: int = 1) -> bytes:
    empty, pointers = array_of(b"K\x00\x85", b"", b"cnumpy\ndtype\nU\x02i8\x85R"), bytes(8 * n_pointers)
    index = array_of(b"M" + struct.pack("<H", n_pointers) + b"\x85", pointers, b"cnumpy\ndtype\nU\x02i8\x85R")
    return (
        CSC
        + b"}(U\x04dataQ".replace(b"Q", empty)
        + b"U\x07indices"
        + empty
        + b"U\x06indptr"
        + index
        + b"U\x05shape"
        + (rows + columns + b"\x86ub")
    )


PICKLES: dict[str, bytes] = {
    "shared tuples as a key": b"\x80\x02}" + PAIRS + b"Ns.",
    "shared tuples in a set": b"\x80\x04(" + PAIRS + b"\x91.",
    "shared tuples as a value": b"\x80\x02}U\x01f" + PAIRS + b"s.",
    "shared tuples as a shape": b"\x80\x02}U\x01f" + array_of(PAIRS, b"") + b"s.",
    "shared tuples as a type": b"\x80\x02}U\x01f" + array_of(b")", b"", b"cnumpy\ndtype\n" + PAIRS + b"\x85R") + b"s.",
    "shared tuples as a name": b"\x80\x04" + PAIRS + PAIRS + b"\x93.",
    "a deep tuple as a key": b"}" + DEEP + b"Ns.",
    "a deep tuple as a value": b"}U\x01f" + DEEP + b"s.",
    "a deep tuple alone": DEEP + b".",
    "deep lists": b"]" * 90_000 + b"a" * 89_999 + b".",
    "deep objects": b"}U\x01f" + CH * 5000 + b"b" * 4999 + b"s.",
    "a variable of itself": b"}U\x01f" + b"cchumpy.ch\nCh\n)\x81q\x01}U\x01xh\x01sbs.",
    "a list of itself": b"}U\x01f]q\x01h\x01as.",
    "bytes as a key": b"}C\x01fNs.",
    "a number as a key": b"}K\x01Ns.",
    "a memo of 34 GB": b"}U\x01fNr\xff\xff\xff\x7fs.",
    "an entry that isn't there": b"}U\x01fj\xff\xff\xff\x7fs.",
    "text of 2 GB": b"}U\x01fT\xff\xff\xff\x7fs.",
    "bytes of 2⁶² B": b"}U\x01f\x8e" + struct.pack("<Q", 1 << 62) + b"s.",
    "a buffer of 2⁶² B": b"}U\x01f\x96" + struct.pack("<Q", 1 << 62) + b"s.",
    "a number of 2³¹ B": b"}U\x01f\x8b\xff\xff\xff\x7fs.",
    "a long decimal": b"}U\x01fL" + b"9" * 1_000_000 + b"L\ns.",
    "a long fraction": b"}U\x01fF" + b"9" * 1_000_000 + b"\ns.",
    "a frame of 2⁵⁰ B": b"\x80\x04\x95" + struct.pack("<Q", 1 << 50) + b"N.",
    "many opcodes": b"N" * 1_000_000 + b".",
    "many marks": b"(" * 1_000_000 + b".",
    "an array of many axes": b"}U\x01f"
    + array_of(b"(" + b"\x8a\xfe" + b"\x7f" * 254 + (b"2" * 100_000) + b"t", b"")
    + b"s.",
    "an array larger than its bytes": b"}U\x01f" + array_of(b"J\xff\xff\xff\x7f\x85", b"") + b"s.",
    "an array without a size": b"}U\x01f" + array_of(b"J\xff\xff\xff\x7fK\x00\x86", b"") + b"s.",
    "an array of wide text": b"}U\x01f" + array_of(b"K\x01\x85", b"", b"cnumpy\ndtype\nU\x0bU2147483647\x85R") + b"s.",
    "an array of parts": b"}U\x01f" + array_of(b"K\x01\x85", b"", b"cnumpy\ndtype\nU\x0a(9999,)f8\x85R") + b"s.",
    "a sparse gigabyte": b"}U\x0bJ_regressor" + sparse(b"J\xff\xff\xff\x07", b"K\x00") + b"s.",
    "a sparse gigabyte for each key": b"}("
    + b"".join(b"U" + bytes([len(key)]) + key.encode() + sparse(b"J\0\0\0\1", b"K\1", 2) for key in MODEL)
    + b"u.",
    "sparse negative sizes": b"}U\x0bJ_regressor" + sparse(b"J\xff\xff\xff\xff", b"J\xff\xff\xff\xff", 0) + b"s.",
    "a persistent object": b"}U\x01fPx\ns.",
    "an extension": b"}U\x01f\x82\x01s.",
    "an old-style instance": b"}U\x01f(ios\nsystem\ns.",
    "a class that is changed": b"}U\x01fcchumpy.ch\nCh\n}U\x01xNsbs.",
    "ESC in a name": b"c\x1b]0;owned\x07os\nsystem\n.",
    "a line without an end": b"cnumpy",
    "nothing but a stop": b".",
    "wide text": b"}U\x01fX" + struct.pack("<I", 100_000_003) + b"\xe7\x8c\xab" + b"x" * 100_000_000 + b"s.",
    "wide text in a line": b"}U\x01fV\\U0001F600" + b"x" * 100_000_000 + b"\ns.",
}


@pytest.mark.parametrize("content", PICKLES.values(), ids=PICKLES)
def test_hostile_pickles(tmp_path: Path, content: bytes) -> None:
    message = refusal(lambda: load_body(pkl(tmp_path, content)))
    assert message.startswith(f"{tmp_path}/model.pkl: ")
    assert message.isprintable()


def test_every_opcode_alone_and_every_name_built_in_every_way(tmp_path: Path) -> None:
    def all_of_them() -> None:
        for opcode in pickletools.opcodes:
            for rest in (b"", b"\0", b"\xff" * 9, b"1\n", b"a\nb\n"):
                content = b"}U\x01f((N)]}" + opcode.code.encode("latin1") + rest + b"s."
                with pytest.raises(ValueError, match=r"model\.pkl"):
                    load_body(pkl(tmp_path, content))
        for name in NAMES:
            module, _, last = name.rpartition(".")
            for use in (b"(tR", b"N\x85R", b")\x81", b"(N}tR}U\x05stateNsb", b"U\x01aNN\x87R(NNNNNtb"):
                content = b"}U\x01fc" + f"{module}\n{last}\n".encode() + use + b"s."
                with pytest.raises(ValueError, match=r"model\.pkl"):
                    load_body(pkl(tmp_path, content))

    run_limited(all_of_them)


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_models_of_all_protocols_are_read(tmp_path: Path, protocol: int) -> None:
    wide = MODEL | {"f": MODEL["f"].astype(np.uint32), "weights": np.asfortranarray(MODEL["weights"])}
    body = load_body(pkl(tmp_path, pickle.dumps(wide | {"betas": [1.5] * 10, "name": "ä"}, protocol)))
    np.savez(tmp_path / "model.npz", **wide)
    assert body.fingerprint == load_body(tmp_path / "model.npz").fingerprint


# Archives -----------------------------------------------------------------------------------------

POSES, RATE = np.zeros((3, 72)), np.array(30.0)


def npy(array: Any) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


def header(text: str, rest: bytes = b"", version: bytes = b"\1\0") -> bytes:
    """An array file whose header is `text`."""
    size = struct.pack("<H" if version == b"\1\0" else "<I", len(text))
    return b"\x93NUMPY" + version + size + text.encode() + rest


def claim(dtype: str, shape: str) -> str:
    return f"{{'descr': {dtype}, 'fortran_order': False, 'shape': {shape}, }}\n"


def archive(folder: Path, **members: bytes | tuple[int, bytes]) -> Path:
    """An archive of array files; one that is given as (n, content) goes on with n zeros, deflated to little."""
    path, packed, directory = folder / "x.npz", b"", b""
    for name, content in members.items():
        n, start = content if isinstance(content, tuple) else (0, content)
        data, crc, file_name = start, zlib.crc32(start), f"{name}.npy".encode()
        if n:
            data, crc = deflated(start) + deflated(bytes(1 << 20)) * (n >> 20) + b"\3\0", 0
        method = 8 if n else 0
        sizes = struct.pack("<5H3L2H", 20, 0, method, 0, 0, crc, len(data), len(start) + n, len(file_name), 0)
        directory += b"PK\1\2\x14\0" + sizes + bytes(10) + struct.pack("<L", len(packed)) + file_name
        packed += b"PK\3\4" + sizes + file_name + data
    end = struct.pack("<4s4H2LH", b"PK\5\6", 0, 0, len(members), len(members), len(directory), len(packed), 0)
    path.write_bytes(packed + directory + end)
    return path


@cache
def deflated(data: bytes) -> bytes:
    packer = zlib.compressobj(wbits=-15)
    return packer.compress(data) + packer.flush(zlib.Z_FULL_FLUSH)


def bomb(dtype: str, shape: str, n: int) -> tuple[int, bytes]:
    return n, header(claim(dtype, shape))


ARCHIVES: dict[str, dict[str, Any]] = {
    "3 GB of zeros": {"poses": bomb("'<f8'", "(5592405, 72)", 3 << 30)},
    "bytes that widen to gigabytes": {"poses": bomb("'|i1'", "(2752512, 72)", 189 << 20)},
    "half floats that widen": {"poses": bomb("'<f2'", "(1376256, 72)", 189 << 20)},
    "betas that widen": {"poses": npy(POSES), "betas": bomb("'|i1'", "(201326592,)", 192 << 20)},
    "an array of no bytes a word": {"poses": header(claim("'<U0'", "(2147483648,)"))},
    "an array of no bytes": {"poses": header(claim("'|V0'", "(2147483648,)"))},
    "a shape with a zero": {"poses": header(claim("'<f8'", "(4611686018427387904, 0)"))},
    "a negative shape": {"poses": header(claim("'<f8'", "(-1, -72)"), bytes(576))},
    "a shape of huge numbers": {"poses": header(claim("'<f8'", f"({'9' * 4000}, {'9' * 4000})"))},
    "a shape of many axes": {"poses": header(claim("'<f8'", f"({'1, ' * 2000})"), bytes(8))},
    "a header of gigabytes": {"poses": (192 << 20, header("", version=b"\2\0")[:-4] + b"\0\0\0\x0c")},
    "a header of brackets": {"poses": header("(" * 9000)},
    "a header of signs": {"poses": header("-" * 9000 + "1")},
    "a wide word": {"poses": npy(POSES), "gender": bomb("'<U50331648'", "()", 192 << 20)},
    "complex numbers": {"poses": npy(np.full((3, 72), complex("nan")))},
    "parts": {"poses": npy(np.zeros(3, [("a", "f8"), ("b", "O")]))},
    "long doubles": {"poses": npy(np.zeros((3, 72), np.longdouble))},
    "dates": {"poses": npy(np.zeros((3, 72), "M8[s]"))},
    "one number": {"poses": npy(1.0), "mocap_framerate": npy(30.0)},
    "a root of one number": {"Rh": npy(1.0), "poses": npy(POSES), "mocap_framerate": npy(30.0)},
    "no rate": {"poses": npy(POSES), "rate": npy(RATE)},
    "a rate near zero": {"poses": npy(POSES), "mocap_framerate": npy(1e-300)},
    "a rate that isn't a number": {"poses": npy(POSES), "mocap_framerate": npy(np.nan)},
    "a rate in words": {"poses": npy(POSES), "mocap_framerate": npy("thirty")},
    "a rate of truth": {"poses": npy(POSES), "mocap_framerate": npy(True)},
}


@pytest.mark.parametrize("members", ARCHIVES.values(), ids=ARCHIVES)
def test_hostile_motions(tmp_path: Path, members: dict[str, Any]) -> None:
    path = archive(tmp_path, **({"mocap_framerate": npy(RATE)} if "rate" not in str(members) else {}), **members)
    assert refusal(lambda: read_motion(path)).isprintable()


@pytest.mark.parametrize("key", ["f", "v_template", "weights", "kintree_table", "shapedirs", "posedirs", "J_regressor"])
def test_hostile_bodies(tmp_path: Path, key: str) -> None:
    good = {name: npy(array) for name, array in MODEL.items()}

    def all_of_them() -> None:
        for content in (
            *(npy(np.array(2.0)), npy(np.zeros((0, 3))), npy(np.full((3, 3), np.inf)), npy("x")),
            npy(np.zeros((2,) * 20)),
            *(header(claim(kind, "(2147483648,)")) for kind in ("'<U0'", "'|V0'", "'|S0'", "'|b1'")),
        ):
            path = archive(tmp_path, **(good | {key: content}))
            error, message = said(lambda: load_body(path))  # noqa: B023
            assert (error, message.isprintable()) == ("", True)

    run_limited(all_of_them)
    path = archive(tmp_path, **(good | {key: bomb("'|i1'", "(104857600, 2)", 200 << 20)}))
    assert run_limited(lambda: load_body(path)).error.isprintable()


def test_a_directory_of_millions_of_members(tmp_path: Path) -> None:
    path = archive(tmp_path, poses=npy(POSES))
    entry = b"PK\1\2" + bytes(42)
    end = struct.pack("<4s4H2LH", b"PK\5\6", 0, 0, 65535, 65535, len(entry) * 3_000_000, 0, 0)
    path.write_bytes(entry * 3_000_000 + end)
    refusal(lambda: read_motion(path))


def test_members_that_overlap_or_share_a_name(tmp_path: Path) -> None:
    path = archive(tmp_path, mocap_framerate=npy(RATE), poses=npy(POSES))
    with zipfile.ZipFile(path, "a") as out, pytest.warns(UserWarning, match="Duplicate"):
        out.writestr("poses.npy", npy(POSES + 1))
    assert "two arrays of one name" in refusal(lambda: read_motion(path))
    path = archive(tmp_path, poses=npy(POSES), padding=npy(POSES))
    data = path.read_bytes()
    first, second = (data.index(b"PK\1\2", at) for at in (0, data.index(b"PK\1\2") + 1))
    path.write_bytes(data[: second + 42] + data[first + 42 : first + 46] + data[second + 46 :])
    refusal(lambda: read_motion(path))


def test_deflated_nothing_of_a_gigabyte(tmp_path: Path) -> None:
    path = archive(tmp_path, poses=npy(POSES))
    data = path.read_bytes()
    at, blocks = data.index(b"PK\1\2"), b"\0\0\0\xff\xff" * 20_000_000
    local = bytearray(data[: at - len(npy(POSES))])
    directory = bytearray(data[at:])
    local[8:10] = directory[10:12] = b"\x08\0"
    directory[20:24] = struct.pack("<I", len(blocks))
    end = directory.index(b"PK\5\6")
    directory[end + 16 : end + 20] = struct.pack("<I", len(local) + len(blocks))
    path.write_bytes(bytes(local) + blocks + bytes(directory))
    refusal(lambda: read_motion(path))


@pytest.mark.parametrize(("lay", "said"), SPECIAL)
def test_what_is_no_file(tmp_path: Path, lay: Callable[[Path], object], said: str) -> None:
    del said
    for read, name in ((load_body, "x.npz"), (load_body, "x.pkl"), (read_motion, "x.npz")):
        folder = tmp_path / f"{read.__name__} {name}"
        folder.mkdir()
        lay(folder / name)
        told = refusal(lambda: read(folder / name))  # type: ignore[operator] # noqa: B023
        assert "can't be read" in told or f"{folder / name} is a folder: wanted" in told


def test_a_slow_rate_is_not_resampled_to_gigabytes(tmp_path: Path) -> None:
    path = archive(tmp_path, poses=npy(np.zeros((2000, 72))), mocap_framerate=npy(0.001))
    assert "at most 1000000 are made" in refusal(lambda: read_motion(path).resampled(30))


# Text and meshes ----------------------------------------------------------------------------------

ONE_ROOT = "HIERARCHY\nROOT a\n{\nOFFSET 0 0 0\nCHANNELS 1 Xrotation\n"
MOTION = "MOTION\nFrames: 1\nFrame Time: 0.03\n0\n"
BVHS = {
    "empty lines": "HIERARCHY\n" + "\n" * 1_000_000 + MOTION,
    "a name of spaces": f"HIERARCHY\nROOT a{' ' * 1_000_000}b\n{MOTION}",
    "joints without numbers": ONE_ROOT
    + "JOINT b\n{\nOFFSET 0 1 0\nCHANNELS 0\n}\n" * 998
    + "}\nMOTION\nFrames: 500000\nFrame Time: 0.03\n"
    + "0 " * 500_000,
}


@pytest.mark.parametrize("text", BVHS.values(), ids=BVHS)
def test_hostile_bvh(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.bvh").write_text(text)
    assert refusal(lambda: read_motion(tmp_path / "a.bvh")).isprintable()


TRIANGLE = np.eye(3, dtype="<f4").tobytes() + np.zeros((3, 2), "<f4").tobytes() + np.arange(3, dtype="<u4").tobytes()


def gltf(blob: bytes = TRIANGLE, **changes: Any) -> bytes:
    """A triangle in a GLB, with other values at the top of its JSON."""
    ends = (0, 36, 60, 72, len(blob))
    views = [{"buffer": 0, "byteOffset": a, "byteLength": b - a} for a, b in pairwise(ends) if b > a]
    kinds = ((5126, "VEC3"), (5126, "VEC2"), (5125, "SCALAR"))
    part = {"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": 0}
    tree = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [part]}],
        "materials": [{}],
        "accessors": [
            {"bufferView": i, "componentType": number, "count": 3, "type": kind}
            for i, (number, kind) in enumerate(kinds)
        ],
        "bufferViews": views,
        "buffers": [{"byteLength": len(blob)}],
    }
    text = json.dumps(tree | changes).encode()
    text, blob = text + b" " * (-len(text) % 4), blob + bytes(-len(blob) % 4)
    head = struct.pack("<4sIIII", b"glTF", 2, 28 + len(text) + len(blob), len(text), 0x4E4F534A)
    return head + text + struct.pack("<II", len(blob), 0x004E4942) + blob


def pictured(picture: bytes) -> bytes:
    """A triangle with a texture."""
    material = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}
    images = {"images": [{"bufferView": 3, "mimeType": "image/png"}], "textures": [{"source": 0}]}
    return gltf(TRIANGLE + picture, materials=[material], **images)


def far(*names: str) -> list[dict[str, Any]]:
    """Accessors of a triangle, of which these have no bytes but many entries."""
    numbers = {"places": (5126, "VEC3"), "uv": (5126, "VEC2"), "corners": (5125, "SCALAR")}
    return [
        {"componentType": number, "type": kind, "count": 10**9}
        if name in names
        else {"componentType": number, "type": kind, "count": 3, "bufferView": i}
        for i, (name, (number, kind)) in enumerate(numbers.items())
    ]


def lid(n: int) -> str:
    return "".join(f"v {np.cos(t):.5f} {np.sin(t):.5f} 0\n" for t in 2 * np.pi * np.arange(n) / n)


PARTS: Any = [{"attributes": {"POSITION": 0}, "indices": 2}]
CORNERS = b"vertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\n"
FACET = b"solid a\nfacet normal 0 0 0\nouter loop\n" + CORNERS + b"endloop\nendfacet\nendsolid a\n"
MESHES = {
    "a place for everybody.glb": gltf(accessors=far("places")),
    "uv for everybody.glb": gltf(accessors=far("uv")),
    "corners for everybody.glb": gltf(accessors=far("corners")),
    "less than nothing.glb": gltf(accessors=[one | {"count": -one["count"]} for one in far("uv")]),
    "one mesh often.glb": gltf(nodes=[{"children": [*range(1, 20_000)]}, *[{"mesh": 0}] * 19_999]),
    "one part often.glb": gltf(meshes=[{"primitives": PARTS * 10_000}]),
    "a chain.glb": gltf(nodes=[*({"children": [i + 1]} for i in range(20_000)), {"mesh": 0}]),
    "a ring.glb": gltf(nodes=[{"children": [1]}, {"children": [2], "mesh": 0}, {"children": [1]}]),
    "a file beside it.glb": gltf(buffers=[{"byteLength": 48, "uri": "/etc/passwd"}]),
    "a file and none.glb": gltf(
        buffers=[{"byteLength": 48, "uri": "/etc/passwd"}, {"byteLength": 3, "uri": "data:,x"}]
    ),
    "brackets.gltf": b"[" * 500_000,
    "lids.obj": (lid(1000) + ("f " + " ".join(map(str, range(1, 1001))) + "\n") * 200).encode(),
    "solids.stl": FACET * 8000,
}


class Left:
    """Garbage of another test, which must not be destroyed in another process."""

    def __init__(self) -> None:
        self.process, self.cycle = os.getpid(), self

    def __del__(self) -> None:
        if os.getpid() != self.process:
            os.abort()


def test_what_other_tests_left_is_not_destroyed_where_a_reader_runs() -> None:
    gc.disable()
    try:
        Left()
        assert not run_limited(gc.collect).error
    finally:
        gc.enable()


@pytest.mark.parametrize("name", MESHES)
def test_hostile_meshes(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(MESHES[name])
    assert "not a mesh that can be read" in refusal(lambda: read_surface(tmp_path / name))


def test_pictures_on_a_mesh_are_not_looked_at(tmp_path: Path) -> None:
    """Pillow runs Ghostscript for some, and unpacks half a gigabyte of half a megabyte for others."""
    for picture in (
        b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n%%EndComments\n(x) print\n%%EOF\n",
        b"no picture",
    ):
        (tmp_path / "a.glb").write_bytes(pictured(picture))
        mesh = read_surface(tmp_path / "a.glb")
        assert len(mesh.faces) == 1
        assert mesh.uv is not None
        np.testing.assert_array_equal(mesh.vertices, np.eye(3))
