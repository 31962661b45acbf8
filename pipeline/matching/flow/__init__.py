"""Dense flow under a known pose, by RAFT or by DIS."""
