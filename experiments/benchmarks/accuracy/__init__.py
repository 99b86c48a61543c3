"""Parts of `speed_accuracy.py`: its methods, what is measured of them, and the picture."""
