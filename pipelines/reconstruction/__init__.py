"""From keypoints in moving cameras to a skeleton with a status and an uncertainty for every joint."""
