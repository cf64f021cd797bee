"""Sources of a flight: reads what flight.yaml names, checks it, and brings it into the world."""
