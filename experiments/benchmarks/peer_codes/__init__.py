"""The codes that `peers.py` measures, one file each, and the pool of pinned workers they run in.

Each file has `build(task, kappas, **options)`. It returns a function to be timed, and the seconds
of its compilation. The function returns the final (Y, V) of all lanes, or their derivatives
as (lanes, 2, 6).
"""
