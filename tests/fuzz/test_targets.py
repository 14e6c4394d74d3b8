"""Every reader under some dozens of hostile inputs, and whether the contract sees who breaks it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, Verbosity, given, seed, settings

from msg_adapters import BagError
from tests.fuzz.contract import BrokenError, Contract, check_line
from tests.fuzz.targets import TARGETS


@pytest.fixture(scope="module")
def contract() -> Contract:
    """One for all: its audit hook stays as long as the process."""
    return Contract()


@pytest.mark.filterwarnings("ignore")  # as at run time
@pytest.mark.parametrize("name", TARGETS)
def test_hostile_input_is_read_or_refused(name: str, contract: Contract, tmp_path: Path) -> None:
    target = TARGETS[name]
    inputs, read = target.open(tmp_path)

    @seed(7)
    @settings(
        max_examples=target.examples,
        suppress_health_check=list(HealthCheck),
        database=None,
        phases=(Phase.generate, Phase.shrink),
        verbosity=Verbosity.quiet,  # the contract says what is wrong; inputs may have a million bytes
    )
    @given(inputs)
    def holds(value: Any) -> None:
        contract.hold(read, value)

    executions, refused = contract.executions, contract.refused
    holds()
    assert contract.executions - executions >= target.examples
    # The one leaves out what is damaged, the other holds commands to their exit status.
    assert contract.refused > refused or name in ("loss_log", "arguments")


# The contract -------------------------------------------------------------------------------------


def crash(_: Any) -> None:
    _ = {}["missing"]


def hang(_: Any) -> None:
    while True:
        pass


def fill(_: Any) -> None:
    np.ones(1000 << 17)  # far more than what anything else in the process may free meanwhile


def call(_: Any) -> None:
    subprocess.run([sys.executable, "-c", ""], check=False, start_new_session=True)  # from 3.13 on it spawns otherwise


def write(_: Any) -> None:
    Path("written-by-a-reader").write_text("")


BREAKS: dict[Any, tuple[str, float]] = {
    crash: ("KeyError: ", 30.0),
    hang: ("hang: ", 0.5),
    fill: ("memory, then: read", 30.0),
    call: ("forbidden: subprocess.Popen", 30.0),
    write: ("forbidden: open", 30.0),
}
"""How each is told, and the processor time that it may take [s]: who doesn't hang isn't to be taken for slow."""


@pytest.mark.parametrize("read", BREAKS)
def test_the_contract_sees_who_breaks_it(read: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    home = Path.home() if os.access(Path.home(), os.W_OK) else Path.cwd()
    monkeypatch.chdir(home)  # which isn't a folder for temporary files
    try:
        told, seconds = BREAKS[read]
        with pytest.raises(BrokenError, match=told):
            Contract(seconds=seconds, megabytes=100).hold(read, b"")
    finally:
        (home / "written-by-a-reader").unlink(missing_ok=True)


@pytest.mark.parametrize("message", ["", "no bag: \x1b[2J", "no bag\udcff", "no bag" * 100])
def test_a_message_is_one_line_that_prints(message: str) -> None:
    with pytest.raises(BrokenError, match="message: here"):
        check_line(message, "here")


def test_who_keeps_it_is_counted() -> None:
    contract = Contract()
    assert contract.hold(lambda _: None, b"")

    def refuse(_: Any) -> None:
        raise BagError("no bag")

    assert not contract.hold(refuse, b"")
    assert (contract.executions, contract.refused) == (2, 1)
