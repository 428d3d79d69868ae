"""Line of progress for a whole sweep: runs done, failed, infeasible, time left."""

import sys
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from threading import Event, Thread

from rich.console import Console
from rich.live import Live
from rich.text import Text

from ssm_study.engine.records import FINAL, RUNNING, read_record

QUIET_S = 30.0  # without a terminal: a line at most this often, and one at the end


class Progress:
    """Counter of the outcomes of a sweep's runs, which prints the progress on stderr. It updates
    one line on a terminal, and prints a new line now and then elsewhere."""

    def __init__(self, total: int) -> None:
        self.total = total
        self.counts = Counter[str]()
        self.reused = 0
        self.running = 0
        self.started = time.monotonic()
        self.spoken = self.started
        self.live: Live | None = None
        if sys.stderr.isatty():
            self.live = Live(console=Console(stderr=True), transient=True, auto_refresh=False)

    def __enter__(self) -> "Progress":
        if self.live:
            self.live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self.live:
            self.live.stop()
        print(self.progress_line(), file=sys.stderr, flush=True)

    def count_outcome(self, status: str, reused: bool = False) -> None:
        """Count the outcome of one finished run of a sweep and print the progress."""
        self.counts[status] += 1
        self.reused += reused
        self._show_progress_line()

    def update_running_jobs(self, running: int) -> None:
        """Set the number of running jobs of a sweep and print the progress."""
        self.running = running
        self._show_progress_line()

    def progress_line(self) -> str:
        """Progress of a sweep in one line: `12/60 runs: 10 ok, 1 infeasible, 1 failed; 8 there
        before; 2 running; 3:20 left`."""
        statuses = (*FINAL, *sorted(set(self.counts) - set(FINAL)))
        counts = [f"{self.counts[status]} {status}" for status in statuses]
        parts = [f"{self.counts.total()}/{self.total} runs: {', '.join(counts)}"]
        if self.reused:
            parts.append(f"{self.reused} there before")
        if self.running:
            parts.append(f"{self.running} running")
        seconds = self.seconds_left()
        if seconds:
            parts.append(f"{int(seconds // 60)}:{int(seconds % 60):02d} left")
        return "; ".join(parts)

    def seconds_left(self) -> float | None:
        """Estimate of the seconds until a sweep is finished, from the mean time of its finished
        runs; None before the first."""
        fresh = self.counts.total() - self.reused  # runs there before took no time now
        remaining = self.total - self.counts.total()
        if not fresh or not remaining:
            return None
        return (time.monotonic() - self.started) / fresh * remaining

    def _show_progress_line(self) -> None:
        """Update the progress line on a terminal; elsewhere print a new line if the last one is old
        enough."""
        if self.live:
            self.live.update(Text(self.progress_line()), refresh=True)
        elif time.monotonic() - self.spoken > QUIET_S:
            self.spoken = time.monotonic()
            print(self.progress_line(), file=sys.stderr, flush=True)


class ProgressWatcher(Thread):
    """Thread that prints the progress of a sweep from its run folders, for launchers that report
    none."""

    def __init__(self, folders: Sequence[Path], every_s: float = 2.0) -> None:
        super().__init__(daemon=True)
        self.folders = list(dict.fromkeys(folders))
        self.every_s = every_s
        self.over = Event()
        self.there_before = sum(status in FINAL for status in self._run_statuses())

    def __enter__(self) -> "ProgressWatcher":
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Read the run folders a last time, print the last progress line, and stop."""
        self.over.set()
        self.join(timeout=30)  # a dead network file system must not hold up the end

    def run(self) -> None:
        """Print the progress every few seconds until the sweep is over."""
        with Progress(total=len(self.folders)) as progress:
            progress.reused = self.there_before
            # Sleeps, yet wakes at once when the sweep is over.
            while not self.over.wait(self.every_s):
                self._update_progress(progress)
            self._update_progress(progress)  # the last line is of how it ended

    def _update_progress(self, progress: Progress) -> None:
        """Count the statuses in the run folders of a sweep and print the progress."""
        statuses = self._run_statuses()
        progress.counts = Counter(status for status in statuses if status in FINAL)
        progress.update_running_jobs(running=statuses.count(RUNNING))

    def _run_statuses(self) -> list[str]:
        """Status of each run of the sweep, read from the run folders."""
        return [str((read_record(folder) or {}).get("status")) for folder in self.folders]
