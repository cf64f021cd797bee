"""Poses, cameras, triangulation, alignment, noise models and metrics: arrays in, arrays out."""
