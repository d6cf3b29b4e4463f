"""Random scenes, what must be true of them, and the command `benchmarks/fuzz.py`."""
