"""The subcommands of `refu`, a module each: `add` makes the parser, `run` does the work and returns the exit code.

What a command needs is imported when it runs, so that `refu --help` doesn't wait for torch.
"""

from refu_lab.commands import benchmark, evaluate, export, garment, info, replay, simulate, stress, train, view

COMMANDS = (replay, view, garment, export, simulate, train, evaluate, benchmark, stress, info)
