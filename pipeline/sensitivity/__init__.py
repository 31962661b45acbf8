"""What injected errors of the logged pose do to the depths."""
