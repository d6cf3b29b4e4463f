"""What benchmarks/work_precision.py measures: runs that are kept, and settings of the whole tube."""
