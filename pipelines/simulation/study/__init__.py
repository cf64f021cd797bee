"""Studies of what the reconstruction error depends on: what is asked, and what is filmed."""
