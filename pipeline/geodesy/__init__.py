"""Local east-north-up frame, vertical datums and the output CRS. Imports numpy and pyproj."""
