"""What is fast and what is not: a module per subject, run by `python -m experiments.benchmarks.X`.

`python -m experiments.benchmarks.run` runs them all. Absolute speeds belong to one machine; the
ratios, measured in one process in alternation, are what to compare.
"""
