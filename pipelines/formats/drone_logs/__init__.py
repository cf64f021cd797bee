"""Logs of drones that are not of ROS: PX4, ArduPilot, DJI; and what all of them hold."""
