"""Joints over time, as biomechanics and animation take them."""
