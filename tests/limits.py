"""Limits on what hostile input may cost."""

import signal
from contextlib import contextmanager


@contextmanager
def in_time(seconds):
    """What runs inside ends, or fails."""

    def stop(*_):
        raise AssertionError(f"it took more than {seconds} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
