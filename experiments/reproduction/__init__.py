"""Reproduction of the paper's Figures 2, 3 and 4: pictures, measurements, and its claims tested."""
