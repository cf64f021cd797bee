"""Joints over time, in the formats of biomechanics and animation."""
