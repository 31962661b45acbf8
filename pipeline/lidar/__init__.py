"""LiDAR tiles by chunk, which returns a camera sees, and the reference depth at a pixel. Imports laspy."""
