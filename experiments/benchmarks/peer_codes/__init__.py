"""The codes that `peers.py` measures, one file each, and the pool of pinned workers they run in.

Each file has `build(task, kappas, **options)`, which returns a timed call, giving the final (Y, V)
of all lanes, or its derivatives as (lanes, 2, 6), and the seconds that its compilation took.
"""
