"""Runs what needs a process of its own in a copy of this one, which has imported torch already."""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from subprocess import CompletedProcess
from tempfile import TemporaryFile


def run_forked(
    call: Callable[[], int | None], *, cwd: Path | None = None, forgets: Sequence[str] = ()
) -> CompletedProcess[str]:
    """The exit status of `call` (1 where it raises), and what it prints; packages in `forgets` are imported anew."""
    with TemporaryFile("w+") as out, TemporaryFile("w+") as err:
        child = os.fork()
        if not child:
            status = 1
            try:
                for number, name, file in ((1, "stdout", out), (2, "stderr", err)):
                    os.dup2(file.fileno(), number)
                    setattr(sys, name, os.fdopen(number, "w"))
                os.chdir(cwd or Path.cwd())
                for name in [name for name in sys.modules if name.partition(".")[0] in forgets]:
                    del sys.modules[name]
                status = call() or 0
            except BaseException:
                traceback.print_exc()
            finally:
                sys.stdout.flush()
                sys.stderr.flush()
                os._exit(status)
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        printed = [(file.seek(0), file.read())[1] for file in (out, err)]
    return CompletedProcess([], status, *printed)
