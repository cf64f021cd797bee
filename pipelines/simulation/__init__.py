"""Flights with known truth: motion, drones and the files they would bring home."""
