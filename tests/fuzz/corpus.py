"""Valid files of every kind, small, and the attacks that are known by name."""

from __future__ import annotations

import bz2
import contextlib
import io
import json
import lzma
import pickle
import sqlite3
import struct
import zlib
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import trimesh
from mcap.writer import CompressionType, Writer
from scipy.sparse import coo_array, csr_array, lil_array

import msg_adapters as adapters
from refu_core import SmplFrame, load_body, load_garment
from refu_core.backbones import BasisDecoder, MlpConfig, TailorNetConfig, build_backbone, save_backbone, save_basis
from refu_core.refu import Refu, refu_tensors
from refu_core.simulation._store import SEQUENCES, columns_of
from tests.fuzz.containers import join_mcap, mcap_bombs, mcap_chunk, npy_bytes, pack_zip, split_mcap

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

GARMENT = "short-pant-male"

GADGETS = [
    b"cos\nsystem\n(S'true'\ntR",
    b"c__builtin__\neval\n(S'1'\ntR",
    b"cbuiltins\ngetattr\n(cnumpy\nndarray\nS'__init__'\ntR",
    b"cnumpy\nndarray\n)\x81",
    b"c_codecs\nencode\n(S'x'\nS'latin1'\ntR",
    b"c_codecs\nencode\n(N}S'__defaults__'\n(S'x'\ntstb",
    b"cchumpy.ch\nCh\n)\x81}S'x'\nN\x73b",
    b"cscipy.sparse.csc\ncsc_matrix\n)\x81",
    b"ccopy_reg\n_reconstructor\n(cnumpy\nndarray\nc__builtin__\nobject\nNtR",
    b"r\xff\xff\xff\x7f",  # a memo of two thousand million entries
    b"p4000000000\n",
    b"T\xff\xff\xff\x7f",  # a string of 2 GiB, which isn't there
    b"\x8e" + struct.pack("<Q", 1 << 40),
    b"\x96" + struct.pack("<Q", 1 << 33),
    b"\x95" + struct.pack("<Q", 1 << 50),
    b"\x8b\xff\xff\xff\x7f",  # a number of 2 GiB
    b"]" * 3000 + b"a" * 2999,
    b"(" * 2000 + b"t" * 2000,
    b"}N" + b"2\x86" * 60 + b"Ns",  # a key whose hash takes 2^60 steps
    b"(N" + b"2\x86" * 60 + b"\x91",  # the same in a frozenset
    b"})" + b"\x85" * 100_000 + b"Ns",  # a key that is nested deeper than the stack
    *(
        b"Pid\n",
        b"\x82\x01",
        b"\x97",
        b"2",
        b"0",
        b"N",
        b"}",
        b"s",
        b"b",
        b"R",
        b"(lp0\nh\x00a",
        b"2\x86",
        b"\x85",
        b")",
    ),
]
"""Opcodes of pickles: calls, states, references, nested keys, and lengths that nobody should believe."""

BOMB_YAML = "\n".join(
    ["rosbag2_bagfile_information:", "  storage_identifier: mcap", "  a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    + [f"  a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 10)]
    + ["  relative_file_paths: [*a9]"]
).encode()
"""Ten thousand million letters."""
MERGED_YAML = BOMB_YAML.replace(b"[*a9]", b"[x]") + b"\n  z: {<<: [*a8, *a9]}"
YAML_WORDS = [
    *(
        b"\n",
        b":",
        b"-",
        b"&a",
        b"*a",
        b"<<:",
        b"!!python/object:os.system",
        b"[",
        b"{",
        b"mcap",
        b"0",
        b"~",
        b"9" * 99,
    ),
    *(
        b'!!int ""',
        b'!!float ""',
        b"1:1:1",
        b"1:",
        b"!!binary x",
        b"!!timestamp 9999-99-99",
        b"!!set {a}",
        b"bag_0.mcap, ",
    ),
]


def some_frame(seed: int = 0, *, with_style: bool = False) -> SmplFrame:
    """A frame with all its fields set."""
    rng = np.random.default_rng(seed)
    pose, betas, style = (rng.normal(size=n).astype(np.float32) for n in (72, 10, 4))
    return SmplFrame(pose, betas=betas, transl=rng.normal(size=3), style=style if with_style else None, stamp_ns=7)


# Bags and motion ----------------------------------------------------------------------------------


def bags(path: Path) -> list[bytes]:
    """MCAP files, two of them valid; writes at `path`."""
    with adapters.BagWriter(path, chunk_bytes=900, overwrite=True) as writer:
        for kind in ("multiarray", "smpl_msgs"):
            writer.add_topic(f"/{kind}/smpl_params", adapters.INPUT_TYPES[kind])
            for i in range(3):
                writer.write(f"/{kind}/smpl_params", adapters.encoder_for(kind)(some_frame(i)), log_time_ns=1 + i)
    plain = Writer(stream := io.BytesIO(), chunk_size=900, compression=CompressionType.NONE)
    plain.start(profile="ros2")
    schema = plain.register_schema(adapters.INPUT_TYPES["multiarray"], "ros2msg", b"")
    channel = plain.register_channel("/smpl_params", "cdr", schema)
    for i in range(3):
        plain.add_message(channel, 1 + i, adapters.encoder_for("multiarray")(some_frame(i)), 1 + i)
    plain.finish()
    found = [path.read_bytes(), stream.getvalue()]
    first = split_mcap(found[0])[:1]
    for part in mcap_bombs(struct.pack("<BQ", 4, 0)):
        many = part * ((48 << 20) // len(part))
        found.append(join_mcap([*first, (6, mcap_chunk(many))]))
    return [*found, join_mcap([*first, (6, mcap_chunk(bytes(9), claimed=1 << 60))])]


def bag_folder(folder: Path) -> tuple[bytes, str]:
    """A rosbag2 directory; returns its metadata, and the name of its one file."""
    with adapters.BagWriter(folder) as writer:
        writer.add_topic("/smpl_params", adapters.INPUT_TYPES["multiarray"])
        writer.write("/smpl_params", adapters.encoder_for("multiarray")(some_frame()), log_time_ns=5)
    return (folder / "metadata.yaml").read_bytes(), next(folder.glob("*.mcap")).name


def npz_bytes(arrays: dict[str, NDArray[Any]]) -> bytes:
    """An archive of arrays."""
    return pack_zip([(f"{name}.npy", npy_bytes(array)) for name, array in arrays.items()])


def motions() -> list[bytes]:
    """AMASS-style archives."""
    rng = np.random.default_rng(0)
    common = {"trans": rng.normal(size=(4, 3)), "betas": rng.normal(size=16), "mocap_framerate": np.array(30.0)}
    arrays = [{"poses": rng.normal(size=(4, width)), **common} for width in (72, 156, 165)]
    arrays.append(
        {"poses": np.zeros((1, 72), np.float32), "mocap_frame_rate": np.array([30]), "gender": np.array(b"male")}
    )
    return [
        *map(npz_bytes, arrays),
        *(npz_bytes(arrays[0] | {"mocap_framerate": np.array(fps)}) for fps in (1e-300, 1e9)),
    ]


# Bodies -------------------------------------------------------------------------------------------


def body_arrays(n: int) -> dict[str, NDArray[Any]]:
    """An SMPL-layout body of `n` vertices."""
    rng = np.random.default_rng(n)
    weights = rng.random((n, 24))
    parents = [2**32 - 1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21]
    return {
        "v_template": rng.normal(size=(n, 3)),
        "f": np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]], np.uint32),
        "weights": weights / weights.sum(1, keepdims=True),
        "J_regressor": np.full((24, n), 1 / n),
        "kintree_table": np.array([parents, range(24)]),
        "shapedirs": rng.normal(size=(n, 3, 10)),
        "posedirs": rng.normal(size=(n, 3, 207)),
    }


def body_archives() -> list[bytes]:
    """Bodies as `.npz`, one with a shape that isn't there."""
    arrays = body_arrays(8)
    claims = [(f"{name}.npy", _claiming(array)) for name, array in arrays.items()]
    return [npz_bytes(arrays), pack_zip(claims), npz_bytes(arrays | {"f": np.array(3)})]


def _claiming(array: NDArray[Any]) -> bytes:
    """An array file that claims to hold a million times as much as there is."""
    header = npy_bytes(np.zeros((1, *array.shape[1:]), array.dtype)) if array.ndim else npy_bytes(array)
    return header.replace(b"(1,", b"(1000000000000,").replace(b", }" + b" " * 12, b", }")


def motion_pickles() -> list[bytes]:
    """Motions as pickles of every protocol: a dictionary a person, a dictionary a frame, packed, of tensors."""
    rng = np.random.default_rng(0)
    person = {
        "pose_world": rng.normal(size=(4, 72)),
        "trans_world": rng.normal(size=(4, 3)),
        "betas": np.zeros((4, 10)),
    }
    body = {"global_orient": np.eye(3)[None], "body_pose": np.tile(np.eye(3), (23, 1, 1)), "betas": np.zeros(10)}
    frames = {f"{i}.jpg": {"smpl": [body], "tid": [1], "path": "x"} for i in range(3)}
    found = [pickle.dumps({np.int64(1): person, 2: person}, protocol) for protocol in range(6)]
    found.append(pickle.dumps(frames, 4))
    tensors = {"smpl_global_orient": torch.zeros(3, 3), "smplBodyPose": torch.zeros(3, 69), "Th": torch.zeros(3)}
    stream = io.BytesIO()
    torch.save(tensors, stream, _use_new_zipfile_serialization=False)
    found += [pickle.dumps(tensors, 4), stream.getvalue(), bz2.compress(found[2]), lzma.compress(found[2])]
    found.append(pickle.dumps({"Rh": np.zeros((3, 3)), "poses": np.zeros((3, 72)), "joints": np.zeros((3, 22, 3))}, 4))
    return [*found, *(data[:-1] + gadget + b"." for data in found[2:3] for gadget in GADGETS), zlib.compress(found[2])]


def body_pickles() -> list[bytes]:
    """Bodies as pickles of every protocol, as the official files are, and with each gadget at the end."""
    found = [*(pickle.dumps(body_arrays(6), protocol) for protocol in range(6)), _chumpy_pickle()]
    found += [found[2][:-1] + gadget + b"." for gadget in GADGETS]
    body = body_arrays(6)
    for kept in (csr_array, coo_array, lil_array, torch.as_tensor):
        found.append(pickle.dumps(body | {"J_regressor": kept(body["J_regressor"])}, 2))
    return [*found, b"(dS'f'\ncchumpy.ch\nCh\n)\x81q\x01}S'x'\nh\x01sbs."]  # a variable that is its own value


def _chumpy_pickle() -> bytes:
    """Text opcodes, chumpy variables, a sparse regressor."""
    body = b"(d"
    for name, array in body_arrays(6).items():
        value = pickle.dumps(array, 2)[2:-1]
        if name == "shapedirs":
            value = b"cchumpy.ch\nCh\n)\x81}S'x'\n" + value + b"sb"
        elif name == "J_regressor":
            parts = {"data": array.T.ravel(), "indices": np.tile(np.arange(24), 6), "indptr": np.arange(0, 145, 24)}
            state = b"".join(
                b"S'%s'\n" % key.encode() + pickle.dumps(part, 2)[2:-1] + b"s" for key, part in parts.items()
            )
            value = b"cscipy.sparse.csc\ncsc_matrix\n)\x81}" + state + b"S'_shape'\n(K\x18K\x06tsb"
        body += b"S'%s'\n" % name.encode() + value + b"s"
    return body + b"."


# Weights and data sets ----------------------------------------------------------------------------


def small_weights(folder: Path, kind: type[TailorNetConfig] | type[MlpConfig]) -> tuple[Path, Any]:
    """Stem of untrained weights with a ReFU layer, small in all but the number of vertices, and their garment."""
    garment = load_garment(GARMENT)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        basis = BasisDecoder(
            torch.zeros(garment.n_vertices, 3), torch.linalg.qr(torch.randn(3 * garment.n_vertices, 4)).Q.T
        )
        sizes: dict[str, Any] = (
            {"low": (4,), "high": (4,), "style_shape": (4,)} if kind is TailorNetConfig else {"hidden": (4, 4)}
        )
        network = build_backbone(kind((0, 1, 2), **sizes), garment, basis=basis, pivots=torch.randn(2, 14))
        layer = Refu(garment.n_vertices, least=0.0)
    folder.mkdir(parents=True, exist_ok=True)
    card = {"garment": garment.name, "body_fingerprint": load_body(garment.body).fingerprint}
    save_basis(folder, basis, card)
    name = "tailornet" if kind is TailorNetConfig else "mlp"
    stem = folder / f"{name}-hybrid"
    save_backbone(stem, network, {**card, "refu": layer.config}, others=refu_tensors(layer))
    return stem, garment


def set_files(kind: str) -> dict[str, bytes]:
    """The files of a data set of three rows."""
    rows, n, frames = 3, 5, 4
    is_sequences = kind == SEQUENCES
    columns = columns_of(kind, (frames, n, 3) if is_sequences else (n, 3))
    files = {}
    for name, (shape, dtype) in columns.items():
        array = np.zeros((rows, *shape), dtype)
        if name == "slot":
            array[:] = np.arange(rows)
        if name == "state":
            array[:] = 1
        files[f"shard-0-of-1/{name}.npy"] = npy_bytes(array)
    if not is_sequences:
        files["unseen.npy"] = npy_bytes(np.zeros(rows, np.float32))
    card = {
        "format": kind,
        "garment": GARMENT,
        "body": "male",
        "body_fingerprint": "0",
        "quantum_m": 2.0**-14,
        "plan": {"garment": GARMENT, "count": rows, "seed": 0, "pivots": 4},
        "clips": {"train": ["walk"], "test": ["run"]},
        "settings": asdict(MlpConfig((0,))),
    }
    return {"card.json": json.dumps(card).encode(), **files}


def sqlite_bag(path: Path) -> bytes:
    """A bag in rosbag2's other storage."""
    with contextlib.closing(sqlite3.connect(path)) as database, database:
        database.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)")
        database.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INT, timestamp INT, data BLOB)")
        database.execute(
            "INSERT INTO topics VALUES (1, '/multiarray/smpl_params', ?, 'cdr')", (adapters.INPUT_TYPES["multiarray"],)
        )
        data = adapters.encoder_for("multiarray")(some_frame())
        database.executemany("INSERT INTO messages VALUES (?, 1, ?, ?)", [(i, i, data) for i in range(1, 20)])
    return path.read_bytes()


BVH_WORDS = (
    b"JOINT a b\n{\n",
    b"\n",
    b" ",
    b"}",
    b"End Site\n{\n",
    b"CHANNELS 0\n",
    b"CHANNELS 1000000 ",
    b"0 ",
    b"1e999 ",
)


def _bvh() -> bytes:
    """A skeleton of chains from the hips, by Mixamo's names."""
    chains = [f"{side}UpLeg {side}Leg {side}Foot" for side in ("Left", "Right")]
    chains += ["Spine Neck Head", *(f"{side}Arm {side}ForeArm {side}Hand" for side in ("Left", "Right"))]
    ways = ["0.1 0 0", "0 -0.4 0", "0 -0.4 0"], ["-0.1 0 0", "0 -0.4 0", "0 -0.4 0"], ["0 0.3 0", "0 0.25 0", "0 0.1 0"]
    ways += ["0.2 0.5 0", "0.25 0 0", "0.25 0 0"], ["-0.2 0.5 0", "-0.25 0 0", "-0.25 0 0"]
    turn = "CHANNELS 3 Zrotation Yrotation Xrotation"
    lines = ["HIERARCHY", "ROOT Hips", "{", "OFFSET 0 0 0", turn]
    for names, offsets in zip(chains, ways, strict=True):
        for name, offset in zip(names.split(), offsets, strict=True):
            lines += [f"JOINT {name}", "{", f"OFFSET {offset}", turn]
        lines += ["}"] * 3
    return "\n".join([*lines, "}", "MOTION", "Frames: 2", "Frame Time: 0.03", *["0 " * 48] * 2]).encode()


BVH = _bvh()
MESH_WORDS = (
    b"f 1 2 3\n",
    b"f 1/1 -1//2 3 4 5 6\n",
    b"v 0 0 0\n",
    b"nan ",
    b"1e999 ",
    b"element face 1000000000\n",
    b"solid a\n",
)


def meshes() -> dict[str, bytes]:
    """A small mesh in each format, by its suffix."""
    mesh = trimesh.creation.icosphere(subdivisions=1)
    found: dict[str, bytes] = {}
    for kind in ("obj", "ply", "stl", "off", "glb"):
        content: str | bytes = mesh.export(file_type=kind)
        found[f".{kind}"] = content.encode() if isinstance(content, str) else content
    files = trimesh.exchange.gltf.export_gltf(trimesh.Scene(mesh), embed_buffers=True)
    return found | {".gltf": files["model.gltf"]}
