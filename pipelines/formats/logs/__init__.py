"""Recordings of messages (ROS 1, ROS 2, MCAP), and what their messages say."""
