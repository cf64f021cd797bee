"""Readers and writers of videos, and of the times of their frames."""
