"""rosbag2 bags: MCAP written as ROS 2 Jazzy writes it, MCAP and SQLite read as a stream, all without ROS."""

from msg_adapters.bags._metadata import QosProfile
from msg_adapters.bags._reader import BAG_SUFFIXES, BagMessage, BagReader, TopicInfo
from msg_adapters.bags._recorder import Recorder, RecorderState, free_path
from msg_adapters.bags._smpl import FrameRecord, SmplBag, iter_smpl_frames, open_smpl_bag
from msg_adapters.bags._writer import BagWriter

__all__ = [
    "BAG_SUFFIXES",
    "BagMessage",
    "BagReader",
    "BagWriter",
    "FrameRecord",
    "QosProfile",
    "Recorder",
    "RecorderState",
    "SmplBag",
    "TopicInfo",
    "free_path",
    "iter_smpl_frames",
    "open_smpl_bag",
]
