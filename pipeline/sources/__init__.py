"""One reader per format: a path becomes typed records, and nothing else in the project knows a format."""
