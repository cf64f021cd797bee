"""Readers of the parts that a manifest names, as records, independent of their format."""
