"""Doubts about a flight's description: what its pictures, poses and people cannot all be true of."""
