"""World points with covariance, voxel merge, tiles, the GeoParquet dataset and other formats."""
