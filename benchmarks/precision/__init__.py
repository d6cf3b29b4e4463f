"""What benchmarks/work_precision.py measures beside the artery to t = 150: the whole tube, chosen steps."""
