"""Rotations, cameras, epipolar transfer, triangulation and covariance. Imports numpy alone."""
