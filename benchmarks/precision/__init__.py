"""What benchmarks/work_precision measures beside the artery to t = 150: the long hold, the tendon, the seeds."""
