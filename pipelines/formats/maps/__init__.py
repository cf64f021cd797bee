"""Readers and writers of voxel maps, point clouds and floor plans."""
