"""The cases of `benchmarks/stability.py`, their references, and how they are run, judged and reported."""
