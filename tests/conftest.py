"""Shared by all tests: one thread, where real motion lies, and how often properties are tried."""

from __future__ import annotations

import gc
import importlib.util
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from refu_core._collector import collect_rarely, keep_what_is_loaded

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # read when NumPy is imported; the programs say so themselves
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # of some hundred processes each would compile all modules again
sys.dont_write_bytecode = False  # pytest, too, would rewrite all tests again in each of its processes

_MISSING = [name for name in ("torch", "warp", "hypothesis", "rosbags") if not importlib.util.find_spec(name)]

if "hypothesis" not in _MISSING:
    from hypothesis import HealthCheck, settings

    settings.register_profile(  # the same examples every time, however busy the machine: tests/fuzz draws others
        "refu", deadline=None, max_examples=40, derandomize=True, suppress_health_check=[HealthCheck.too_slow]
    )
    settings.load_profile("refu")

collect_rarely()

if importlib.util.find_spec("torch"):  # the adapters' tests run without it
    import torch

    torch.set_num_threads(1)  # as the node runs; and the figures of two test runs agree to the bit

# What earlier tests left belongs to threads that a forked process hasn't got: destroyed there, it crashes.
os.register_at_fork(after_in_child=gc.freeze)


LONGEST = (
    "lab/test_replay.py",
    "test_style.py",
    "ros/test_node_outputs.py",
    "ros/test_packaging.py",
    "core/test_simulation.py",
    "core/test_simulation_lanes.py",
    "core/test_fitting_places.py",
    "core/test_stability.py",
    "ros/test_node_requests.py",
    "lab/test_garment.py",
    "lab/test_evaluate.py",
    "core/test_training_backbone.py",
    "ros/test_node_recording.py",
    "lab/test_fleet.py",
    "core/test_kernel_bounds.py",
    "core/test_fitting_files.py",
    "core/test_own_body.py",
    "test_faults.py",
    "test_arguments.py",
    "ros/test_node.py",
    "ros/test_node_lazy.py",
    "core/test_training_refu.py",
    "core/test_hostile_files.py",
    "lab/test_own_body_commands.py",
    "lab/test_stress.py",
    "core/test_pipeline.py",
    "core/test_fitting.py",
    "lab/test_train.py",
    "lab/test_reproduction.py",
    "core/test_assets.py",
    "core/test_press.py",
    "core/test_kernel_cache.py",
    "lab/test_benchmark.py",
    "core/test_outfits.py",
    "core/test_dynamics.py",
    "core/test_graph.py",
    "ros/test_node_life.py",
    "ros/test_node_faults.py",
    "ros/test_node_stays_up.py",
    "fuzz/test_targets.py",
    "test_node_parts.py",
    "lab/test_view.py",
)
"""Files of tests, the one that takes longest first: begun last, one of them would keep a single process busy while all
others have nothing left to do."""


def pytest_configure(config: pytest.Config) -> None:
    """pytest-xdist begins with the files of most tests unless it is told otherwise."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # in a shell's background; programs would inherit it
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if hasattr(config.option, "loadscopereorder"):
        config.option.loadscopereorder = False


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files that take long come first; the others, and the tests in each, stay in their order."""
    tests = Path(__file__).parent
    place = {tests / name: i for i, name in enumerate(LONGEST)}
    items.sort(key=lambda item: place.get(item.path, len(place)))


def pytest_collection_finish() -> None:
    """What has been imported stays: a collector that goes through it again and again took a tenth of the time."""
    gc.collect()
    keep_what_is_loaded()


class Unable(pytest.Module):
    """A file of tests that isn't imported."""

    def collect(self) -> list[pytest.Item]:
        reason = f"{', '.join(_MISSING)} can't be imported by {sys.executable}: see docs/guide/install.md, Tests"
        pytest.skip(reason, allow_module_level=True)


def pytest_pycollect_makemodule(module_path: Path, parent: pytest.Collector) -> Unable | None:
    """`colcon test` of a workspace passes where pip's packages aren't; whoever runs pytest is told by an error."""
    under_colcon = parent.config.getoption("--junit-prefix") == "refu_ros"
    return Unable.from_parent(parent, path=module_path) if under_colcon and _MISSING else None


@pytest.fixture(scope="session", autouse=True)
def cache(tmp_path_factory: pytest.TempPathFactory) -> None:
    """What is kept from one process to the next is kept apart from the user's own; the workers of a run share it."""
    base = tmp_path_factory.getbasetemp()
    os.environ["REFU_CACHE"] = str((base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "cache")


@pytest.fixture(scope="session")
def motions() -> list[Path]:
    """Recorded human motion (AMASS-style npz); its folder is REFU_MOTIONS, or ../shared/motions beside the checkout."""
    default = Path(__file__).resolve().parents[2] / "shared" / "motions"
    folder = Path(os.environ.get("REFU_MOTIONS", default))
    clips = sorted(folder.glob("*.npz"))
    if not clips:
        pytest.skip(f"no recorded motion in {folder}: set REFU_MOTIONS to a folder of AMASS-style npz files")
    return clips


@pytest.fixture
def little_light(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures with few rays from sun and sky, small ones in reports: what light does, lab/test_render.py tests."""
    for name, value in (("_SUN_RAYS", 4), ("_SKY_RAYS", 8), ("_GROUND_STEP", 0.2)):
        monkeypatch.setattr(f"refu_lab.render.{name}", value)
    monkeypatch.setattr("refu_lab.report._PICTURE", (105, 160))


def _without_curves() -> Iterator[None]:
    """Trainings that draw no loss curves after each stage, which takes longer than a stage of twenty steps."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("refu_core.training.TrainingLog.draw", lambda _: None)
        yield


no_curves = pytest.fixture(_without_curves)
no_curves_in_module = pytest.fixture(_without_curves, scope="module")
