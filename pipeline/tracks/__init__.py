"""Poses over time: interpolation, the camera's mount on the vehicle, the pose at an exposure with its covariance."""
