"""rosbag2 bags: MCAP written as ROS 2 Jazzy writes it, MCAP and SQLite read as a stream, all without ROS."""

from msg_adapters.bags._metadata import QosProfile as QosProfile
from msg_adapters.bags._metadata import TopicInfo as TopicInfo
from msg_adapters.bags._reader import BAG_SUFFIXES as BAG_SUFFIXES
from msg_adapters.bags._reader import BagMessage as BagMessage
from msg_adapters.bags._reader import BagReader as BagReader
from msg_adapters.bags._recorder import Recorder as Recorder
from msg_adapters.bags._recorder import RecorderState as RecorderState
from msg_adapters.bags._recorder import RunningRecording as RunningRecording
from msg_adapters.bags._recorder import free_path as free_path
from msg_adapters.bags._recorder import path_in as path_in
from msg_adapters.bags._smpl import FrameRecord as FrameRecord
from msg_adapters.bags._smpl import SmplBag as SmplBag
from msg_adapters.bags._smpl import iter_smpl_frames as iter_smpl_frames
from msg_adapters.bags._smpl import open_smpl_bag as open_smpl_bag
from msg_adapters.bags._writer import LIBRARY as LIBRARY
from msg_adapters.bags._writer import BagWriter as BagWriter
