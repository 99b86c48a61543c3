"""Headline numbers of the studies, computed by cheaper methods.

Each function is named after a study. Its keys are the names of the numbers in that study.
"""
