"""What the studies and benchmarks share: how they are run, their tables, clocks and pictures."""
