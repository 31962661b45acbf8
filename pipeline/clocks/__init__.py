"""Time bases and what ties them together: GPS time, a log's boot clock, a camera's clock."""
