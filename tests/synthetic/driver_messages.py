"""Definitions of messages that rosbags does not know: px4_msgs, gps_common and gps_msgs.

By the packages' public definitions (PX4 1.15, gps_umd). Logs hold their own definitions, so fields of a
message that no reader asks for are left out here.
"""

from __future__ import annotations

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
_PX4 = {
    "VehicleLocalPosition": """
uint64 timestamp
uint64 timestamp_sample
bool xy_valid
bool z_valid
float32 x
float32 y
float32 z
uint8 xy_reset_counter
bool xy_global
bool z_global
uint64 ref_timestamp
float64 ref_lat
float64 ref_lon
float32 ref_alt
float32 eph
float32 epv
""",
    "VehicleAttitude": """
uint64 timestamp
uint64 timestamp_sample
float32[4] q
float32[4] delta_q_reset
uint8 quat_reset_counter
""",
    "VehicleOdometry": """
uint64 timestamp
uint64 timestamp_sample
uint8 POSE_FRAME_NED=1
uint8 POSE_FRAME_FRD=2
uint8 pose_frame
float32[3] position
float32[4] q
uint8 velocity_frame
float32[3] velocity
float32[3] angular_velocity
float32[3] position_variance
float32[3] orientation_variance
float32[3] velocity_variance
uint8 reset_counter
int8 quality
""",
    "SensorGps": """
uint64 timestamp
uint64 timestamp_sample
uint32 device_id
float64 latitude_deg
float64 longitude_deg
float64 altitude_msl_m
float64 altitude_ellipsoid_m
uint8 fix_type
float32 eph
float32 epv
uint64 time_utc_usec
""",
    "GimbalDeviceAttitudeStatus": """
uint64 timestamp
uint8 target_system
uint8 target_component
uint16 device_flags
float32[4] q
float32 angular_velocity_x
float32 angular_velocity_y
float32 angular_velocity_z
uint32 failure_flags
""",
}


def register(store: Typestore, *, px4: bool) -> Typestore:
    """Add the types of GPS receivers, and PX4's if wanted, to a store."""
    for package in ("gps_common", "gps_msgs"):
        store.register(get_types_from_msg(_GPS_STATUS, f"{package}/msg/GPSStatus"))
        store.register(get_types_from_msg(_GPS_FIX.format(package=package), f"{package}/msg/GPSFix"))
    for name, definition in _PX4.items() if px4 else ():
        store.register(get_types_from_msg(definition, f"px4_msgs/msg/{name}"))
    return store
