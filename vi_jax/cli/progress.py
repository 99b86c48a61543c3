"""What is at work, and how long it will take."""

import sys
import threading
import time
from types import TracebackType

# Seconds from one countdown to the next, and below which what is left is not said in numbers:
# choices.
_PAUSE, _SOON = 0.5, 5.0


class Countdown:
    """Says on the error stream which step is at work and how long all will still take; in a
    terminal the seconds count down by themselves."""

    def __init__(self):
        self._begin = time.perf_counter()
        self._step, self._left, self._since = "", 0.0, self._begin
        self._moves, self._ended = sys.stderr.isatty(), threading.Event()
        self._thread = threading.Thread(target=self._tick, daemon=True)

    def __enter__(self) -> "Countdown":
        if self._moves:
            self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._ended.set()
        if self._moves:
            self._thread.join()
            self._close()

    def __call__(self, step: str, left: float) -> None:
        """A step begins, with about so many seconds left for it and all after it."""
        if self._moves and self._step:
            self._close()
        self._step, self._left, self._since = step, left, time.perf_counter()
        self._show()

    def _tick(self) -> None:
        while not self._ended.wait(_PAUSE):
            if self._step:
                self._show()

    def _show(self) -> None:
        now = time.perf_counter()
        left = self._left - (now - self._since)
        ahead = f"about {left:.0f} s" if left > _SOON else "some seconds"
        line = f"[{now - self._begin:3.0f} s, {ahead} left] {self._step} …"
        clear, end = ("\r\x1b[K", "") if self._moves else ("", "\n")
        print(clear + line, end=end, file=sys.stderr, flush=True)

    def _close(self) -> None:
        print(file=sys.stderr, flush=True)
