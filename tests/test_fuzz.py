"""The worst inputs that fuzzing has found, each by itself."""

from __future__ import annotations

import io
import json
import pickle
import struct
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from msg_adapters import BagError, BagReader, BagWriter, EncodeError, MarkerMesh, read_motion
from refu_core import BodyError, WeightsError, load_body
from refu_core.options import SettingsError
from refu_core.simulation import SimulationError, load_clips
from refu_core.simulation._store import FORMAT, Rows
from refu_core.training import TrainingLog
from refu_core.training._record import load_checkpoint, save_checkpoint
from refu_ros._settings import NodeSettings
from tests.fuzz.containers import join_mcap, mcap_chunk, split_mcap


def pickled(tmp_path: Path, content: bytes) -> Path:
    (tmp_path / "model.pkl").write_bytes(content)
    return tmp_path / "model.pkl"


def test_a_sparse_matrix_of_more_entries_than_it_has(tmp_path: Path) -> None:
    parts = {"data": np.ones(2), "indices": np.zeros(2, int), "indptr": np.array([0, 1 << 40])}
    state = b"".join(b"S'%s'\n" % key.encode() + pickle.dumps(part, 2)[2:-1] + b"s" for key, part in parts.items())
    matrix = b"cscipy.sparse.csc\ncsc_matrix\n)\x81}" + state + b"S'_shape'\n(K\x18K\x01tsb"
    with pytest.raises(BodyError, match="J_regressor can't be read"):
        load_body(pickled(tmp_path, b"(dS'J_regressor'\n" + matrix + b"s."))


def npz(path: Path, members: dict[str, bytes], method: int = zipfile.ZIP_STORED) -> Path:
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, content in members.items():
            archive.writestr(f"{name}.npy", content)
    return path


def npy(array: Any) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


def test_an_array_that_claims_more_than_there_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # of a long line, as that of a long path, the middle is left out
    poses = npy(np.zeros((3, 72))).replace(b"(3, 72), }" + b" " * 14, b"(100000000000000, 72), }")
    path = npz(Path("a.npz"), {"poses": poses, "mocap_framerate": npy(np.array(30.0))})
    with pytest.raises(ValueError, match="takes 57600000000000000 bytes, the file has 1728"):
        read_motion(path)


def test_compression_that_asks_for_gigabytes(tmp_path: Path) -> None:
    path = npz(tmp_path / "a.npz", {"poses": npy(np.zeros((3, 72)))}, zipfile.ZIP_LZMA)
    with pytest.raises(ValueError, match="only deflate is read"):
        read_motion(path)


def test_a_checkpoint_unpacks_nothing(tmp_path: Path) -> None:
    save_checkpoint(tmp_path / "good.checkpoint", {"step": 1})
    with (
        zipfile.ZipFile(tmp_path / "good.checkpoint") as good,
        zipfile.ZipFile(tmp_path / "packed.checkpoint", "w", zipfile.ZIP_DEFLATED) as packed,
    ):
        for entry in good.infolist():
            packed.writestr(entry.filename, good.read(entry))
    with pytest.raises(WeightsError, match="compressed records"):
        load_checkpoint(tmp_path / "packed.checkpoint")


def test_a_checkpoint_with_records_larger_than_itself(tmp_path: Path) -> None:
    save_checkpoint(tmp_path / "a.checkpoint", {"step": 1})
    whole = (tmp_path / "a.checkpoint").read_bytes()
    at = whole.index(b"PK\x01\x02") + 20  # of the directory: the first record's sizes, packed and not
    (tmp_path / "a.checkpoint").write_bytes(whole[:at] + struct.pack("<II", 700_000_000, 700_000_000) + whole[at + 8 :])
    with pytest.raises(WeightsError, match="larger than the file"):
        load_checkpoint(tmp_path / "a.checkpoint")


def test_a_frame_rate_in_a_row_of_one_is_a_frame_rate(tmp_path: Path) -> None:
    arrays = {"poses": np.zeros((3, 72)), "mocap_framerate": np.array([30.0])}
    path = npz(tmp_path / "a.npz", {name: npy(array) for name, array in arrays.items()})
    assert (load_clips(path)[0].fps, read_motion(path).fps) == (30.0, 30.0)


def test_metadata_that_stands_for_more_text_than_fits_a_memory(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        writer.add_topic("/a", "std_msgs/msg/Float32MultiArray")
    lines = ["rosbag2_bagfile_information:", "  storage_identifier: mcap", "  a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    lines += [f"  a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 12)]
    (tmp_path / "bag" / "metadata.yaml").write_text("\n".join([*lines, "  relative_file_paths: [*a11]"]))
    with pytest.raises(BagError, match="not rosbag2 metadata"):
        BagReader(tmp_path / "bag")


@pytest.mark.parametrize("record", [bytes(1 << 20), struct.pack("<BQ", 0x7F, 0) * 100_000])
def test_a_chunk_that_unpacks_to_a_thousand_times_its_size(tmp_path: Path, record: bytes) -> None:
    path = tmp_path / "bag.mcap"
    with BagWriter(path) as writer:
        writer.add_topic("/a", "std_msgs/msg/Float32MultiArray")
    header = split_mcap(path.read_bytes())[:1]
    path.write_bytes(join_mcap([*header, (6, mcap_chunk(record * (1 + (20 << 20) // len(record))))]))
    with BagReader(path) as reader:
        assert list(reader.messages()) == []
        assert reader.truncated
        assert any("MiB" in warning and "that unpacks to 2" in warning for warning in reader.warnings)


def test_numbers_that_fit_no_parameter() -> None:
    for values in ({"max_rate": 10**400}, {"betas": [10**400] * 10}):
        with pytest.raises(SettingsError, match="wanted a"):
            NodeSettings().changed(values)


def test_things_that_are_no_arrays() -> None:
    with pytest.raises(EncodeError, match="faces: wanted an array of numbers"):
        MarkerMesh("a", [[1, 2], [3]], 4)  # type: ignore[arg-type]


def test_a_column_that_was_cut_short_is_not_lengthened(tmp_path: Path) -> None:
    Rows.create(tmp_path, FORMAT, np.arange(4, dtype=np.int32), (9, 3))
    path = tmp_path / "shard-0-of-1" / "vertices.npy"
    path.write_bytes(path.read_bytes()[:-50])
    size = path.stat().st_size
    with pytest.raises(SimulationError, match=r"takes 216 bytes, the file has 166"):
        Rows(tmp_path, FORMAT, mode="r+")
    assert path.stat().st_size == size


def test_loss_curves_go_on_after_half_a_line(tmp_path: Path) -> None:
    log = TrainingLog(tmp_path, name="log", quiet=True)
    log.check("low", 10, train=1.0)
    path = tmp_path / "log.jsonl"
    path.write_text(path.read_text() + '{"stage": "low", "st\n[]\n{"stage": 3}\n')
    TrainingLog(tmp_path, name="log", quiet=True).check("low", 20, train=0.5)
    assert [json.loads(line)["step"] for line in path.read_text().splitlines()] == [10, 20]
