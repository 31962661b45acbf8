"""One writer per log format: the recording of the simulated flight as an autopilot or camera would leave it."""
