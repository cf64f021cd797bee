"""Benchmarks, with comparisons to other tools; docs/benchmarks.md holds their figures."""
