"""Room for meshes in the shared memory that Fast DDS sends through.

Its default, half a megabyte, holds less than one message of garments. A subscriber that stands still (in a debugger, or
swapping) occupies what it hasn't read, at most the 512 pieces of 64 kB that its queue holds. Once that fills the
segment, nobody else gets anything either, often not even after the subscriber has gone. 40 MB can't be filled.
"""

from __future__ import annotations

import os
import shutil
from contextlib import suppress
from pathlib import Path

PROFILES = Path(__file__).with_name("fastdds.xml")
SEGMENT_BYTES = 40_000_000
"""The segment of `fastdds.xml`: 512 pieces of 65,500 bytes, and some."""
_VARIABLES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE", "FASTDDS_BUILTIN_TRANSPORTS")


def make_room() -> bool:
    """Tells Fast DDS to use `fastdds.xml`, in this process, before `rclpy.init`; returns whether it was told.

    If the user has configured Fast DDS in any of its ways, that stays. If there is too little shared memory (as in some
    containers), Fast DDS keeps its defaults. Other middleware doesn't read the variable.
    """
    chosen = any(os.environ.get(name) for name in _VARIABLES) or Path("DEFAULT_FASTRTPS_PROFILES.xml").exists()
    with suppress(OSError):  # there is no such memory
        if not chosen and shutil.disk_usage("/dev/shm").free > SEGMENT_BYTES:
            os.environ[_VARIABLES[0]] = str(PROFILES)
            return True
    return False
