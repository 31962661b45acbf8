"""XFeat and the two matchers that are built on it."""
