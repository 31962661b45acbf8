"""All frames refined together: a factor graph over the flight, points eliminated frame by frame."""
