"""Files for the command line, as tests write them."""

from pathlib import Path

IDEAL = """
[scene]
frequency_ratio = 0.9
damping_ratio = 0.05
"""


def written(text, path="file.toml"):
    Path(path).write_text(text, encoding="utf-8")
    return path
