"""People in pictures, as other detectors write them."""
