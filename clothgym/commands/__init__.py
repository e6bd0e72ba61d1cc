"""The commands, one file each, and what they share: options, output, progress.

A command is an entry of the group `clothgym.commands`: the entry's name is the command's name, its object a function
`register(app: typer.Typer) -> None` that adds the command of that name. `clothgym.cli` loads it when it is called for.
"""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Annotated, Any

import typer

from clothgym.benchmarks.report import Table, print_table, to_json_text

JsonOption = Annotated[
    bool, typer.Option("--json", help="Print one JSON document on standard output and nothing else there.")
]


class Stopped(KeyboardInterrupt):
    """Ctrl-C, with one line that says what was kept; exit code 130."""


def answer(document: dict[str, Any], tables: Sequence[Table], as_json: bool) -> None:
    """The result of a command on standard output: the document with `--json`, otherwise the tables."""
    if as_json:
        sys.stdout.write(to_json_text(document, indent=2) + "\n")
        sys.stdout.flush()
        return
    for table in tables:
        print_table(table)


def say(line: str) -> None:
    """One line for a human, on standard error."""
    print(line, file=sys.stderr, flush=True)


@contextlib.contextmanager
def ctrl_c_between_steps() -> Iterator[Callable[[], None]]:
    """Holds Ctrl-C back until the work says that it may come, so that no file is left in the middle of a step; a
    second Ctrl-C comes at once.

    Yields a function that raises KeyboardInterrupt when Ctrl-C was pressed since; call it between the steps.
    """
    pressed = False

    def note(number: int, place: Any) -> None:
        nonlocal pressed
        if pressed:
            raise KeyboardInterrupt
        pressed = True

    def may_stop() -> None:
        if pressed:
            raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():  # only the main thread may set a handler
        yield may_stop
        return
    before = signal.signal(signal.SIGINT, note)
    try:
        yield may_stop
    finally:
        signal.signal(signal.SIGINT, before)


@contextlib.contextmanager
def reserved_stdout(as_json: bool) -> Iterator[None]:
    """Keeps standard output for the JSON document: what anything else prints meanwhile goes to standard error."""
    if not as_json:
        yield
        return
    with contextlib.redirect_stdout(sys.stderr):
        yield


@contextlib.contextmanager
def progress_bar(title: str, total: float) -> Iterator[Any]:
    """A progress bar on standard error that vanishes at the end; silent when that is no terminal.

    Yields a function `advance(done, text="", total=None)`.
    """
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    console = Console(stderr=True)
    columns = [
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[text]}", markup=False),
    ]
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task(title, total=total, text="")

        def advance(done: float, text: str = "", total: float | None = None) -> None:
            progress.update(task, completed=done, text=text, total=total)

        yield advance
