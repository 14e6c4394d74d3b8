"""The command `refu`, which is `python -m refu_lab`: an interrupt ends it without a traceback from the start."""

import signal
import sys


def main() -> int:
    # An exception in the middle of an import may come out as any other, so there an interrupt raises none.
    before = signal.getsignal(signal.SIGINT)
    if before is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from refu_core._collector import keep_what_is_loaded
    from refu_lab.cli import main as run

    signal.signal(signal.SIGINT, before)
    code = run()
    keep_what_is_loaded()  # else the interpreter's end goes through all of it, for a second and more
    return code


if __name__ == "__main__":
    sys.exit(main())
