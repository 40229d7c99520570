"""One module per domain, each with a `TASK`."""
