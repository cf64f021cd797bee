"""Draft of a flight.yaml: matches files and topics to cameras and writes them. Descriptions in, text out."""
