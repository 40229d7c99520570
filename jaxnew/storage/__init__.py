"""What is kept of a run: its directory, checkpoints, metrics and configuration."""
