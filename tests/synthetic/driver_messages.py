"""Definitions of messages that rosbags does not know: gps_common and gps_msgs.

By the packages' public definitions (gps_umd). Logs hold their own definitions, so fields of a
message that no reader asks for are left out here.
"""

from rosbags.typesys import get_types_from_msg
from rosbags.typesys.store import Typestore

_GPS_STATUS = """
std_msgs/Header header
uint16 satellites_used
int32[] satellite_used_prn
int16 STATUS_NO_FIX=-1
int16 STATUS_FIX=0
int16 status
uint16 motion_source
uint16 orientation_source
uint16 position_source
"""
_GPS_FIX = """
std_msgs/Header header
{package}/GPSStatus status
float64 latitude
float64 longitude
float64 altitude
float64 track
float64 speed
float64 climb
float64 err
float64 err_horz
float64 err_vert
float64[9] position_covariance
uint8 position_covariance_type
"""


def register(store: Typestore) -> Typestore:
    """Add the types of GPS receivers to a store."""
    for package in ("gps_common", "gps_msgs"):
        store.register(get_types_from_msg(_GPS_STATUS, f"{package}/msg/GPSStatus"))
        store.register(get_types_from_msg(_GPS_FIX.format(package=package), f"{package}/msg/GPSFix"))
    return store
