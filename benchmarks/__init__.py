"""Studies and benchmarks: error against run time, stability, accuracy, speed beside other libraries."""
