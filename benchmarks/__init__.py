"""Benchmarks, with comparisons to other tools; docs/results.md holds their figures."""
