"""Command lines: every module here is run as `python -m experiments.NAME`.

The packages hold what the commands share.
"""
