"""Drafting a flight.yaml: what belongs to which camera, and how to say it. Descriptions in, text out."""
