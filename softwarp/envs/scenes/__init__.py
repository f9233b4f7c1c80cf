"""The robots of the tasks, one per file; they also serve inverse control, planning and benchmarks."""
