"""Small complete examples; `docs/` explains how they are written, `tests/examples` runs them."""
