"""What benchmarks/work_precision.py measures beside the artery to t = 150: the long hold, the tendon, the seeds."""
