"""Voxels, clouds and floor plans."""
