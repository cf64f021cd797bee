"""People in pictures, in the files of other detectors."""
