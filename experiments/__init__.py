"""Command lines: every module here is run as `python -m experiments.NAME`."""
