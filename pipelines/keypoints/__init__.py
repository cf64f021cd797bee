"""From detections in pictures to the keypoints of one person: who is the actor, in every view."""
