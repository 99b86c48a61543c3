"""Figures written as small PNG, PDF or SVG files."""

from io import BytesIO
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from .._checks import count, given_number, instance_of
from .._files import write_whole

ENDINGS = (".png", ".pdf", ".svg")
"""What the name of a picture may end in."""

# Text stays text, which can be searched and copied; and the same figure gives the same file.
_VECTORS: dict[Any, Any] = {"pdf.fonttype": 42, "svg.fonttype": "none", "svg.hashsalt": "vi_jax"}
_UNDATED = {".pdf": {"CreationDate": None}, ".svg": {"Date": None}}


def save_picture(
    figure: Figure, path: str | Path, *, dpi: float | int = 110, colors: int = 200
) -> Path:
    """Write a figure as what the name ends in: `.png`, `.pdf` or `.svg`.

    A PNG has few colours, which makes it small and loses nothing in line drawings. A PDF and an SVG
    hold lines and words as such, and maps as images. The file appears whole, or not at all if
    interrupted or if the disk is full.

    **Arguments:**

    - `figure`: one of matplotlib's; that of axes is `ax.figure`.
    - `path`: the file.
    - `dpi`: dots per inch, of a PNG and of the images in a PDF or an SVG.
    - `colors`: colours of a PNG, 256 at most.

    **Returns:** the path.

    **Raises:** `ValueError` for a name that ends in anything else, `OSError` if the file cannot be
    written.
    """
    path = Path(path)
    ending = path.suffix.lower()
    if ending not in ENDINGS:
        raise ValueError(
            f"Argument `path` must end in {', '.join(ENDINGS)}, but got {str(path)!r}."
        )
    instance_of("figure", figure, Figure, "a figure, as `ax.figure` is")
    dpi = given_number("dpi", dpi, low=0.0, open_low=True)
    colors = count("colors", colors, least=2, most=256)
    content = _pixels(figure, dpi, colors) if ending == ".png" else _vectors(figure, ending, dpi)
    write_whole(path, content)
    return path


def _pixels(figure: Figure, dpi: float, colors: int) -> bytes:
    figure.set_dpi(dpi)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    picture = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
    picture = picture.quantize(colors, dither=Image.Dither.NONE)
    png = BytesIO()
    picture.save(png, "png", optimize=True, dpi=(dpi, dpi))
    return png.getvalue()


def _vectors(figure: Figure, ending: str, dpi: float) -> bytes:
    out = BytesIO()
    with matplotlib.rc_context(_VECTORS):
        figure.savefig(out, format=ending[1:], dpi=dpi, metadata=_UNDATED[ending])
    return out.getvalue()
