"""Text kept inside of a PNG, such as the numbers that were drawn."""

from pathlib import Path

from PIL import Image
from PIL.PngImagePlugin import PngInfo


def stamp(picture: str | Path, name: str, words: str) -> None:
    """Put words into a PNG, whose pixels stay as they are.

    **Arguments:** the file; the name under which `stamped` gives the words.
    """
    with Image.open(picture) as image:
        image.load()
        info = PngInfo()
        info.add_itxt(name, words)
        image.save(picture, "png", optimize=True, pnginfo=info, dpi=image.info.get("dpi"))


def stamped(picture: str | Path, name: str) -> str | None:
    """The words of that name in a PNG, or `None`."""
    with Image.open(picture) as image:
        return image.info.get(name)
