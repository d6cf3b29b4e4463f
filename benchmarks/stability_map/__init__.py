"""The cases of `benchmarks/stability`, their references, and how they are run, judged and reported."""
