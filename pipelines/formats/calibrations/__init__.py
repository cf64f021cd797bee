"""Intrinsics and poses of cameras, as calibration programs write them."""
