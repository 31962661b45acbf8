"""Photos and logs brought together: which log, on which clock, at which instant, in which pose."""
