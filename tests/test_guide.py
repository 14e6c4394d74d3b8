"""What the guide's pages show in Python runs, word for word, in the order of the page."""

from __future__ import annotations

import json
import re
import runpy
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from outside_meshes import Outside, quads_of_a_skirt, write_obj

from msg_adapters import BagReader, BagWriter, read_motion

ROOT = Path(__file__).parents[1]


def shorten(bag: Path, to: Path) -> None:
    """The first twenty messages: the others of three hundred are read and dressed by the same lines."""
    to.parent.mkdir()
    with BagReader(bag) as whole, BagWriter(to) as part:
        for topic in whole.topics:
            part.add_topic(topic.name, topic.message_type)
        for message in islice(whole.messages(), 20):
            part.write(message.topic, message.data, log_time_ns=message.log_time_ns)


@pytest.mark.parametrize("page", ["python", "garments", "outputs", "inputs"])
def test_a_pages_python_runs(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = (ROOT / "docs" / "guide" / f"{page}.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^```python\n(.*?)^```$", text, flags=re.DOTALL | re.MULTILINE)
    assert blocks
    # What they read lies beside them.
    shorten(ROOT / "bags" / "walk", tmp_path / "bags" / "walk")
    write_obj(tmp_path / "kilt.obj", Outside(*quads_of_a_skirt(16, 50)))
    np.savez(tmp_path / "clip.npz", poses=np.zeros((3, 72)), trans=np.zeros((3, 3)), mocap_framerate=30.0)
    (tmp_path / "output" / "smpl").mkdir(parents=True)
    person = {name: [[0.0] * size] for name, size in (("Rh", 3), ("Th", 3), ("poses", 72), ("shapes", 10))}
    (tmp_path / "output" / "smpl" / "000000.json").write_text(json.dumps([person]), encoding="utf-8")
    (tmp_path / "page.py").write_text("\n".join(blocks), encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    names = runpy.run_path("page.py")
    if page == "python":
        assert names["pose"].shape == (1, 24, 3)
        assert float(names["sdf"].query(names["done"].vertices).distance.min()) > 0
        assert (tmp_path / "person.glb").stat().st_size > 100_000
    elif page == "outputs":
        assert np.abs(names["out"]["short-pant-male"].vertices - names["mesh"].vertices).max() < 0.002
        assert names["openings"].names == ("waist", "left_leg", "right_leg")
    elif page == "inputs":
        assert names["frame"] is None
        assert len(read_motion("clip.npz")) == 1  # what the page makes of EasyMocap's files
    else:
        assert names["pipeline"].untrained == ("kilt",)
        assert (tmp_path / "kilt.npz").exists()
