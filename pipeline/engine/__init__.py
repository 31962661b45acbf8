"""What runs the stages: configuration, run folder, manifest, executors, progress, errors."""
