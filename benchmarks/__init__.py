"""Measurements beside what others use; docs/benchmarks.md holds their figures."""
