"""The studies' headline numbers, computed with the library as it is, by cheaper ways.

The function named after a study returns numbers by the names under which the study keeps them, each
with the difference that is allowed.
"""
