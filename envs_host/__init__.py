"""Simulators that run in worker processes. Nothing in here imports jax."""
