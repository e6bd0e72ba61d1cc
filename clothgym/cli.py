"""The command line: finds commands through the entry-point group `clothgym.commands` and keeps its exit codes.

Exit codes: 0 done; 1 done with a negative result, or failed while working (one line says what); 2 bad input, with one
line on standard error that names file, field and value; 130 Ctrl-C. A traceback is shown only with `--debug` or
`CLOTHGYM_DEBUG=1`.

No command is imported here: each is loaded when it is called, so a command that lacks an extra harms no other.
"""

from __future__ import annotations

import importlib.metadata
import json
import os
import sys
import traceback
from collections.abc import Sequence
from typing import Annotated, Any

import typer

from clothgym.benchmarks.machine import missing_extra_line, version_of

ENTRY_POINTS = "clothgym.commands"
DONE, FAILED, BAD_INPUT, STOPPED = 0, 1, 2, 130


def entry_points() -> dict[str, importlib.metadata.EntryPoint]:
    """Registered commands by name, sorted; the first of two entries with the same name wins."""
    found: dict[str, importlib.metadata.EntryPoint] = {}
    for entry in importlib.metadata.entry_points(group=ENTRY_POINTS):
        found.setdefault(entry.name, entry)
    return dict(sorted(found.items()))


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one command line and returns its exit code; see the module for the codes."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    words, debug = _take_debug(words)
    commands = entry_points()
    called = next((word for word in words if not word.startswith("-")), None)
    speaker = f"clothgym {called}" if called in commands else "clothgym"
    if os.getcwd() not in sys.path:  # last, so that it shadows nothing: a user's own `package.module:Name`
        sys.path.append(os.getcwd())
    try:
        if called in commands:
            app = _new_app()
            commands[called].load()(app)
        elif called is not None and commands:
            raise ValueError(f"command = {called!r}: expected one of {', '.join(commands)}")
        else:
            app = _new_app() if "--version" in words else _app_of_all(commands)
        return _invoke(app, words)
    except BaseException as error:
        if debug and not isinstance(error, typer.Exit):
            traceback.print_exc()
        return _exit_code(error, speaker)


def _take_debug(words: list[str]) -> tuple[list[str], bool]:
    """The words without `--debug`, wherever it stands before a `--`; and whether it or CLOTHGYM_DEBUG asks for it."""
    end = words.index("--") if "--" in words else len(words)
    rest = [word for word in words[:end] if word != "--debug"]
    debug = len(rest) < end or os.environ.get("CLOTHGYM_DEBUG", "0") not in ("", "0")
    return rest + words[end:], debug


def _new_app() -> typer.Typer:
    """The command line without commands."""
    app = typer.Typer(
        name="clothgym",
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode="markdown",
        context_settings={"help_option_names": ["-h", "--help"]},
    )

    @app.callback(invoke_without_command=True)
    def clothgym(
        context: typer.Context,
        version: Annotated[bool, typer.Option("--version", help="Print the version and leave.")] = False,
        debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks (also CLOTHGYM_DEBUG=1).")] = False,
    ) -> None:
        """Cloth simulation behind Gymnasium environments: contact, untangling, dressing, and their benchmarks."""
        # `debug` is for the help alone: `main` takes it out, so that it may stand anywhere.
        if version:
            print(f"clothgym {version_of('clothgym') or 'from a checkout that is not installed'}")
            raise typer.Exit(DONE)
        if context.invoked_subcommand is None:
            print(context.get_help())
            raise typer.Exit(DONE)

    return app


def _app_of_all(commands: dict[str, importlib.metadata.EntryPoint]) -> typer.Typer:
    """The command line with every command that loads; one line on standard error for each that does not."""
    app = _new_app()
    if not commands:
        _say("clothgym: no command is registered: install the package ('pip install -e .' in a checkout)")
    for name, entry in commands.items():
        try:
            entry.load()(app)
        except Exception as error:
            reason = missing_extra_line(error) if isinstance(error, ImportError) else None
            _say(f"clothgym {name}: not available: {reason or _described(error)}")
    return app


def _invoke(app: typer.Typer, words: list[str]) -> int:
    # Not `app()`: that would print usage errors over several lines and swallow what Ctrl-C has to say.
    command = typer.main.get_command(app)
    try:
        with command.make_context("clothgym", words) as context:
            command.invoke(context)
    except typer.Exit as leave:
        return leave.exit_code
    finally:
        sys.stdout.flush()
    return DONE


def _exit_code(error: BaseException, speaker: str) -> int:
    """Says in one line what went wrong and returns the exit code."""
    if isinstance(error, SystemExit):
        return error.code if isinstance(error.code, int) else FAILED
    if isinstance(error, KeyboardInterrupt | typer.Abort):
        _say(f"{speaker}: {_one_line(str(error)) or 'stopped'}")
        return STOPPED
    if isinstance(error, BrokenPipeError):  # the reader of a pipe has left, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
    _say(f"{speaker}: {_described(error)}")
    return BAD_INPUT if _is_bad_input(error) else FAILED


def _is_bad_input(error: BaseException) -> bool:
    """Whether the user can cure it: a usage error, a bad value or file, a missing extra."""
    if isinstance(error, ImportError) and missing_extra_line(error) is not None:
        return True
    files = (FileNotFoundError, PermissionError, IsADirectoryError, NotADirectoryError, FileExistsError)
    return hasattr(error, "format_message") or isinstance(error, (ValueError, *files))


def _described(error: BaseException) -> str:
    """The error as one line."""
    usage = getattr(error, "format_message", None)  # usage errors of typer, whichever module they come from
    if usage is not None:
        return _one_line(usage())
    if isinstance(error, ImportError) and (line := missing_extra_line(error)) is not None:
        return line
    if isinstance(error, json.JSONDecodeError):
        return f"not valid JSON: {_one_line(str(error))}"
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{_one_line(str(error.filename))}: {error.strerror[:1].lower()}{error.strerror[1:]}"
    text = _one_line(str(error))
    if isinstance(error, ValueError) and text:
        return text
    if isinstance(error, RuntimeError) and text:  # a diverged simulation, a worker that died: the text says it all
        return text
    return f"{type(error).__name__}: {text} (a defect of this program: --debug shows where)"


def _one_line(text: str) -> str:
    return " ".join(text.split())


def _say(line: Any) -> None:
    print(line, file=sys.stderr, flush=True)
