"""The fit of small patches: sub-pixel positions and their covariance."""
