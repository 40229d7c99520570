"""Simulators that run inside jit: one package per domain, imported by its own name."""

__all__: list[str] = []
