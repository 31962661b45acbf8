"""Depth and map metrics against reference depths. Imports numpy."""
