"""All that is fuzzed, by name."""

from __future__ import annotations

from typing import TYPE_CHECKING

from refu_ros.fuzz import _files as files
from refu_ros.fuzz import _messages as messages
from refu_ros.fuzz import _results as results
from refu_ros.fuzz._target import Target

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from refu_ros.fuzz._target import Reader


def _cdr(input_type: str) -> Callable[[Path], Reader]:
    return lambda _: messages.CdrInput(input_type)


_ALL = (
    Target("multiarray", "std_msgs/Float32MultiArray in CDR", 250_000, _cdr("multiarray")),
    Target("joint_state", "sensor_msgs/JointState in CDR", 250_000, _cdr("joint_state")),
    Target("pose_array", "geometry_msgs/PoseArray in CDR", 150_000, _cdr("pose_array")),
    Target("smpl_msgs", "smpl_msgs/Smpl in CDR", 150_000, _cdr("smpl_msgs")),
    Target("definition", "the .msg text that a bag carries", 50_000, lambda _: messages.SmplDefinition()),
    Target("objects", "message objects with odd fields", 50_000, lambda _: messages.MessageObjects()),
    Target("markers", "visualization_msgs/MarkerArray in CDR", 150_000, lambda _: messages.MarkerDecoding()),
    Target("encoder", "odd meshes to a MarkerArray", 50_000, lambda _: messages.MarkerEncoding()),
    Target("parameters", "parameters of the node", 50_000, lambda _: messages.Parameters()),
    # A chunk may take what the reader allows one to, and its bytes once more while they are checked.
    Target("mcap", "MCAP files", 10_000, files.Bag, memory_mb=600, seconds=10.0),
    Target("metadata", "metadata.yaml of a bag", 3_000, files.BagMetadata, seconds=10.0),
    Target("motion", "AMASS-style .npz", 20_000, files.MotionFile),
    Target("body_npz", "bodies as .npz", 20_000, files.BodyArchive),
    Target("body_pkl", "bodies as official .pkl", 40_000, files.BodyPickle),
    Target("tensors", "weights as safetensors", 20_000, results.WeightTensors),
    Target("card", "cards of weights", 20_000, results.WeightCard),
    Target("distance_card", "cards of distance networks", 20_000, results.DistanceCard),
    Target("data_set", "data sets of samples", 10_000, results.DataSet),
    Target("sequences", "data sets of sequences", 10_000, results.SequenceSet),
    Target("checkpoint", "checkpoints of a training", 20_000, results.Checkpoint),
    Target("loss_log", "loss curves of a training", 20_000, results.LossLog),
)
TARGETS: dict[str, Target] = {target.name: target for target in _ALL}
"""What is fuzzed, by name."""
