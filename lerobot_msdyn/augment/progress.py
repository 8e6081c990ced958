"""The progress bar of a run: what is being done, the share of the episodes that is done, and the time that is left."""

import sys
import time
from io import TextIOBase
from typing import Any

from tqdm import tqdm

FORESEEN = 0.05  # share of the work after which what is left can be told
UNWATCHED_S = 30.0  # between updates of a bar that nobody watches: in a file each is a line
FORMAT = "{desc} |{bar}| {percentage:3.0f} % of EPISODES episodes [{elapsed}"


class EpisodeBar(tqdm):
    """Counts episodes, in parts; tells the time left by the average, once enough is done. Use as a context."""

    def __init__(self, total: int, stream: TextIOBase | None = None, *, what: str = "", before: float = 0.0) -> None:
        """Of so many episodes, and work before them that takes as long as `before` episodes."""
        file: Any = sys.stderr if stream is None else stream
        self._watched, self._all = file.isatty(), total + before
        self._format = FORMAT.replace("EPISODES", str(total))
        interval_s = 0.1 if self._watched else UNWATCHED_S
        shown = f"{self._format}]"
        super().__init__(total=self._all, file=file, desc=what, bar_format=shown, mininterval=interval_s, smoothing=0)

    def begin(self, what: str) -> None:
        """Say what is being done now."""
        due = self._watched or time.time() - self.last_print_t >= UNWATCHED_S
        self.set_description_str(what, refresh=due)
        if due:
            self.last_print_t = time.time()

    def advance(self, share: float) -> None:
        """Some share of an episode is done."""
        self.update(min(share, self._all - self.n))  # shares add up to one only up to rounding
        if self.n >= FORESEEN * self._all:
            self.bar_format = f"{self._format}<{{remaining}}]"
