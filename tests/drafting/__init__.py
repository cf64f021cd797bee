"""Tests of the drafting of manifests."""
