"""The paper's Figures 2, 3 and 4 again: drawn, measured, and compared with what it says."""
