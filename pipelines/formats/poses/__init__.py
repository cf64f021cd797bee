"""Trajectories as text."""
