"""Recordings of messages (ROS 1, ROS 2, MCAP), and the conversion of their messages."""
