"""Figures, tables and the self-contained page of `mocap report`."""
