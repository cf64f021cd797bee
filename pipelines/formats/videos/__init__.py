"""Videos, and when their frames were taken."""
