"""rosbag2 bags in MCAP: written as ROS 2 Jazzy writes them, read as a stream, both without ROS."""

from msg_adapters.bags._metadata import QosProfile
from msg_adapters.bags._reader import BagMessage, BagReader, TopicInfo
from msg_adapters.bags._smpl import FrameRecord, SmplBag, iter_smpl_frames, open_smpl_bag
from msg_adapters.bags._writer import BagWriter

__all__ = [
    "BagMessage",
    "BagReader",
    "BagWriter",
    "FrameRecord",
    "QosProfile",
    "SmplBag",
    "TopicInfo",
    "iter_smpl_frames",
    "open_smpl_bag",
]
