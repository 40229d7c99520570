"""What is fast and what is not: one module per subject, run as `python -m experiments.benchmarks.X`.

`python -m experiments.benchmarks.run` runs them all. Absolute speeds belong to one machine; the
ratios, measured in one process in alternation, are what to compare.
"""
