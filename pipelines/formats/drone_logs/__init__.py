"""Logs of drones without ROS (PX4, ArduPilot, DJI), and the rules that all of them share."""
