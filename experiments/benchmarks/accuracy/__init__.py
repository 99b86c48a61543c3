"""Parts of `speed_accuracy.py`: its methods, its measurements and its picture."""
