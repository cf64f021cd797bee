"""Combined maximum a posteriori estimate of a skeleton, of its cameras' pose errors, and of clocks."""
