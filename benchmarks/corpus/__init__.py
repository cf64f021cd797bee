"""Rendered flights with the keypoints of real detectors: half for tuning, half kept aside."""
