"""Readers and writers of trajectories as text."""
