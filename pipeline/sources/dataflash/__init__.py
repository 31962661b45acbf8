"""ArduPilot DataFlash logs, binary and text."""
