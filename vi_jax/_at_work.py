"""What all long verbs have in common: a bar while they work, and what is kept on Ctrl-C."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from tqdm import tqdm

from ._interrupted import Interrupted

Tell = Callable[[int], Any]
"""Told how many more units of work are done."""


def silent(done: int) -> None:
    """Shows nothing."""


@contextmanager
def at_work(
    what: str,
    kept: Callable[[], Interrupted | None],
    *,
    progress: bool,
    unit: str = "it",
    total: int | None = None,
    done: int = 0,
) -> Iterator[Tell]:
    """A part of a verb that may take long: gives a function that is called with what is done.

    **Arguments:** `what`, the word before the bar; `kept`, asked on Ctrl-C, what to raise: an
    `Interrupted` with what was computed, or `None` where there is nothing to keep yet; `progress`,
    whether a bar is shown, which it is in a terminal or a notebook only; the `unit` of work, how
    many there are in all, if that is known, and how many are done already.

    **Raises:** what `kept` gives, on Ctrl-C; else the `KeyboardInterrupt` itself.
    """
    try:
        with tqdm(
            desc=what, total=total, initial=done, unit=f" {unit}", unit_scale=True,
            disable=None if progress else True,
        ) as bar:  # fmt: skip
            yield bar.update
    except KeyboardInterrupt:
        interrupted = kept()
        if interrupted is None:
            raise
        raise interrupted from None
