"""What a frame says is still inside: held against libigl's winding number, in the promised range and far outside."""

from __future__ import annotations

import igl
import numpy as np
import pytest
import torch

from refu_core import GarmentPipeline, SmplFrame
from refu_core.body import JOINT_NAMES
from refu_core.realtime import PROMISED_POSES, within_promise
from refu_core.sdf import Winding
from refu_core.sdf._winding_kernels import STEPS
from refu_lab.stress._frames import FRAMES, everyday, promised


def _n_inside(points: np.ndarray, body: np.ndarray, faces: torch.Tensor) -> int:
    # The fast one sums up what is far off: of whole numbers that is a hundredth.
    vertices, indices = body.astype(np.float64), faces.numpy().astype(np.int64)
    winding = igl.fast_winding_number(vertices, indices, points.astype(np.float64))
    return int((np.round(winding) != 0).sum())


def _twisted(rng: np.random.Generator) -> SmplFrame:
    """Spine and limbs turned as no person can, and a shape far from people."""
    pose = np.zeros((24, 3))
    for name in ("spine1", "spine2", "spine3"):
        pose[JOINT_NAMES.index(name), 1] = rng.uniform(-1.6, 1.6)
    pose[JOINT_NAMES.index("left_shoulder")] = rng.normal(0, 1, 3)
    return SmplFrame(pose=pose, betas=rng.choice([-5.0, 5.0], 10))


@pytest.mark.parametrize(("garment", "sdf"), [("tshirt-male", "hybrid"), ("skirt-female", "accurate")])
def test_every_vertex_inside_is_counted(garment: str, sdf: str) -> None:
    pipeline = GarmentPipeline.load(garment, sdf=sdf)
    rng, any_turn = np.random.default_rng(3), FRAMES["any rotation of any joint"]
    frames = [draw(rng) for draw in (_twisted, promised, everyday) for _ in range(2)]
    rng = np.random.default_rng(0)  # some of whose frames have no way out for some: the seventh, the thirteenth
    frames += [any_turn(rng) for _ in range(15)][5:]
    n_found = 0
    for frame in frames:
        out = pipeline(frame)
        n_inside = _n_inside(out[garment].local, out.body, pipeline.body.faces)
        assert out.stats.is_certified
        # Turning the person into the world rounds: a vertex on the skin itself may fall on its other side.
        assert abs(out.stats.garments[garment].n_unresolved - n_inside) <= 1 + n_inside // 50
        assert out.stats.garments[garment].n_unresolved > 0 or n_inside == 0
        n_found += n_inside
    assert n_found > 0


def test_without_a_certificate_the_frame_says_so() -> None:
    out = GarmentPipeline.load("short-pant-male", backbone="skinned", certify=False)(everyday(np.random.default_rng(0)))
    assert not out.stats.is_certified


def test_winding_numbers_are_libigls_on_vertices_edges_and_far_away() -> None:
    pipeline = GarmentPipeline.load("short-pant-male", backbone="skinned")
    body = pipeline.body.v_template.numpy()
    rng = np.random.default_rng(0)
    faces = pipeline.body.faces
    corners = body[faces.numpy()[:2000]]
    points = [
        body[:500] + np.array((0, 0, 1e-3)),  # lines through vertices
        0.5 * (corners[:, 0] + corners[:, 1]) - np.array((0, 0, 2e-3)),  # and through edges
        body[rng.integers(len(body), size=4000)] + rng.normal(0, 0.03, (4000, 3)),
        rng.normal(0, 1e5, (100, 3)),
    ]
    for where in points:
        winding = Winding(faces)
        winding.update(torch.from_numpy(body))
        here = where.astype(np.float32)
        expected = igl.winding_number(body.astype(np.float64), faces.numpy(), here.astype(np.float64))
        assert np.array_equal(winding(torch.from_numpy(here)).numpy(), np.round(expected))
        winding._steps = winding._launches([(step, 7) for step in range(STEPS)])  # as on a GPU
        for wanted in (0, 1):
            found = winding(torch.from_numpy(here), torch.tensor([wanted], dtype=torch.int32))
            assert np.array_equal(found.numpy(), wanted * np.round(expected)), "nothing is done where none is wanted"


def test_the_promised_range_is_of_rotations_and_of_both_sides() -> None:
    low, high = PROMISED_POSES
    knee, twist = JOINT_NAMES.index("right_knee"), JOINT_NAMES.index("spine1")
    for joint, axis, angle, is_promised in ((knee, 0, 2.5, True), (knee, 0, -1.0, False), (twist, 1, 1.2, False)):
        for turns in (0, 1, -1):
            pose = np.zeros((24, 3))
            pose[joint, axis] = angle + 2 * np.pi * turns
            assert within_promise(SmplFrame(pose=pose)) is is_promised
    assert np.array_equal(low[1] * (1, -1, -1), np.where(np.arange(3) == 0, low[2], high[2]))
    assert not within_promise(SmplFrame(pose=np.zeros((24, 3)), betas=np.eye(10)[4] * 3.1))
    rng = np.random.default_rng(0)
    assert all(within_promise(promised(rng)) for _ in range(200))
