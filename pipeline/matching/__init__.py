"""Features, matching guided by the pose, and the check of the matches against the epipolar geometry."""
