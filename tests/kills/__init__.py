"""Kills of commands at random moments: the same command again must end with the same bytes."""
