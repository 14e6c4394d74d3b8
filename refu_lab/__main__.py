"""The command `refu`, which is `python -m refu_lab`: an interrupt ends it without a traceback from the start."""

import gc
import signal
import sys


def main() -> int:
    """Runs the command line; returns the exit code."""
    # An exception in the middle of an import may come out as any other, so there an interrupt raises none.
    before = signal.getsignal(signal.SIGINT)
    if before is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from refu_lab.cli import main as run

    signal.signal(signal.SIGINT, before)
    code = run()
    gc.freeze()  # else the interpreter's end goes through all that torch and Warp have made, for a second and more
    return code


if __name__ == "__main__":
    sys.exit(main())
