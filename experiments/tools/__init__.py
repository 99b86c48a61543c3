"""Shared code of the studies and benchmarks: running, tables, timing and pictures."""
