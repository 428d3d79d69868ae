"""The board of the temperature control laboratory, through its own package `tclab`, in real time.

Its heater is off at whatever ends a record or a loop: its last sample, an exception, Ctrl-C or a
request to terminate.
What no program sees (a power cut, a kill) ends it, too: the firmware switches off five minutes
after the last command.
"""

import atexit
import signal
import sys
import threading
import time
from typing import Any

from ssm_study.refusal import BadRequest

LOWER = 0.0
UPPER = 100.0  # %
_board: "list[Board]" = []  # the one that is attached


class Board:
    """One sample after another: `hold` applies a duty for a sampling period and reads the sensor at
    its end."""

    def __init__(self, device: Any) -> None:
        self.device = device
        self.due = -float("inf")

    def read(self) -> float:
        """The sensor, degrees C."""
        return float(self.device.T1)

    def hold(self, percent: float, step_s: float) -> float:
        """The sensor `step_s` after the last sample was due; a pause longer than that starts a new
        clock."""
        try:
            now = time.monotonic()
            self.device.Q1(min(max(percent, LOWER), UPPER))
            self.due = (self.due if now - self.due < step_s else now) + step_s
            time.sleep(max(self.due - time.monotonic(), 0.0))
            return self.read()
        except BaseException:  # Ctrl-C among them
            release()
            raise


def attached() -> Board:
    """The board, connected when first asked for. Raises `BadRequest` where there is none."""
    if not _board:
        remedy = "connect the board and pip install tclab, or use plant.hardware=false"
        try:
            import tclab

            device = tclab.TCLab()
        except Exception as error:  # no package, no serial port, no permission: each has its own
            cause = " ".join(str(error).split()).rstrip(".") or type(error).__name__
            raise BadRequest(
                "plant.hardware", True, f"no board answers ({cause})", remedy
            ) from error
        _board.append(Board(device))
        atexit.register(release)
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that `finally` runs
    return _board[0]


def release() -> None:
    """Heaters off and the port closed; the next sample connects again."""
    while _board:
        device = _board.pop().device
        try:
            device.Q1(0)
            device.Q2(0)
        finally:
            device.close()
