"""How every verb ends: a line or one JSON object, an error line, an exit code."""

from __future__ import annotations

import functools
import inspect
import json
import os
import shlex
import sys
import traceback
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, final

import click

from btfkit.cli.bar import Bar
from btfkit.files import reading
from btfkit.jsonvalues import plain

DONE, FAILED, WRONG_USAGE, INTERRUPTED = 0, 1, 2, 130


@final
@dataclass(frozen=True)
class Outcome:
    """What a verb has to say when it is done.

    Attributes:
        line: for people; may span lines.
        data: for scripts: results, figures, output paths.
        then: the command line that one would type next; shown to people alone.
        code: exit code.
    """

    line: str
    data: Mapping[str, Any] = field(default_factory=dict)
    then: str | None = None
    code: int = DONE


@final
@dataclass
class _Manners:
    """The options that every verb has."""

    as_json: bool = False
    quiet: bool = False
    debug: bool = False
    typed: tuple[str, ...] = ()
    code: int = DONE


_manners = _Manners()


@final
class _Command(click.Command):
    """A command whose help may end in what takes a moment to find out."""

    more: Callable[[], str] | None = None

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        if self.more is not None:
            self.epilog = self.more()
        super().format_epilog(ctx, formatter)


def verb(
    name: str,
    *,
    example: str,
    more: Callable[[], str] | None = None,
    writes: Sequence[str] = ("out",),
) -> Callable[[Callable[..., Outcome]], click.Command]:
    """Make a verb of a function that takes a `Bar` and its options, and returns an `Outcome`.

    Args:
        name: the verb.
        example: command lines that `--help` shows.
        more: what stands at its end, asked for when it is shown.
        writes: options that name what is written; nothing written replaces what others name.
    """

    def decorate(function: Callable[..., Outcome]) -> click.Command:
        @functools.wraps(function)
        def call(*, as_json: bool, quiet: bool, debug: bool, **options: Any) -> None:
            _manners.as_json, _manners.quiet, _manners.debug = as_json, quiet, debug
            read = _named(value for key, value in options.items() if key not in writes)
            with (
                reading(read),
                warnings.catch_warnings(record=True) as caught,
                Bar(name, quiet=quiet, lines=not as_json) as bar,
            ):
                warnings.simplefilter("always", UserWarning)
                outcome = function(bar, **options)
            _say(outcome, sorted({str(w.message) for w in caught if _is_ours(w)}))

        for option in (
            click.option("--debug", is_flag=True, help="Show a traceback on failure."),
            click.option("--quiet", is_flag=True, help="No progress, no warnings."),
            click.option("--json", "as_json", is_flag=True, help="One JSON object on stdout."),
        ):
            call = option(call)
        help_text = inspect.cleandoc(function.__doc__ or "") + "\n\nExample:\n\n\b\n" + example
        command = click.command(name, cls=_Command, help=help_text)(call)
        command.more = more
        return command

    return decorate


def _named(values: Iterable[Any]) -> Iterator[Path]:
    """What options name that is there: paths, and files that words happen to be."""
    for value in values:
        if isinstance(value, tuple):
            yield from _named(value)
        elif isinstance(value, Path):
            yield value
        elif isinstance(value, str) and "\0" not in value and os.path.isfile(value):
            yield Path(value)


def run(group: click.Group, arguments: Sequence[str]) -> int:
    """Run the command line; returns the exit code."""
    _manners.as_json = "--json" in arguments
    _manners.debug = "--debug" in arguments
    _manners.typed, _manners.code = tuple(arguments), DONE
    try:
        group.main(list(arguments), prog_name="btfkit", standalone_mode=False)
        sys.stdout.flush()
    except click.exceptions.Exit as ending:
        return ending.exit_code
    except click.UsageError as error:
        if _manners.as_json:
            _print_json({"error": {"type": "usage", "message": error.format_message()}})
        error.show()
        return WRONG_USAGE
    except (KeyboardInterrupt, click.Abort):
        return _failed("Interrupted", "interrupted; what was finished is kept", INTERRUPTED)
    except BrokenPipeError:
        # Whoever read our output has left: no more to say, and nothing to flush at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
    except Exception as error:  # the last place that can answer for it
        if _was_interrupted(error):
            return _failed("Interrupted", "interrupted; what was finished is kept", INTERRUPTED)
        return _failed(type(error).__name__, error_line(error), FAILED)
    return _manners.code


def command_line(*, drop: Sequence[str] = (), add: Sequence[str] = ()) -> str:
    """The command line of this run, without some of its flags and with others."""
    kept = [each for each in _manners.typed if each not in (*drop, *add)]
    return shlex.join(["btfkit", *kept, *add])


def _was_interrupted(error: BaseException) -> bool:
    """Whether an interruption stands behind an error, as where a library wraps all it meets."""
    seen: list[BaseException] = []
    behind: BaseException | None = error
    while behind is not None and behind not in seen:
        if isinstance(behind, KeyboardInterrupt):
            return True
        seen.append(behind)
        behind = behind.__cause__ or behind.__context__
    return False


def error_line(error: Exception) -> str:
    """What is wrong, in one line."""
    from btfkit.errors import BtfkitError

    if isinstance(error, OSError) and error.strerror and error.filename:
        return _in_one(f"{error.filename}: {error.strerror}")
    if isinstance(error, (BtfkitError, OSError, ValueError, TypeError, ModuleNotFoundError)):
        return _in_one(str(error))
    if isinstance(error, MemoryError):
        return _in_one(f"out of memory ({error})")
    return _in_one(f"{type(error).__name__}: {error} (a fault in btfkit; --debug shows where)")


def _shown(text: str) -> str:
    """Text for a terminal: what would move its cursor or turn its letters around is escaped."""
    from btfkit.errors import printable

    return "\n".join(printable(line) for line in text.split("\n"))


def _in_one(text: str) -> str:
    from btfkit.errors import one_line

    # Remedies list what there is, and may be long.
    return one_line(text, 2000)


def _failed(kind: str, message: str, code: int) -> int:
    if _manners.debug:
        traceback.print_exc()
    if _manners.as_json:
        _print_json({"error": {"type": kind, "message": message}})
    print(f"btfkit: error: {_in_one(message)}", file=sys.stderr)  # noqa: T201
    return code


def _is_ours(warning: warnings.WarningMessage) -> bool:
    return issubclass(warning.category, UserWarning) and "btfkit" in Path(warning.filename).parts


def _say(outcome: Outcome, warned: list[str]) -> None:
    if not _manners.quiet:
        for message in warned:
            print(f"btfkit: warning: {_shown(message)}", file=sys.stderr)  # noqa: T201
    if _manners.as_json:
        _print_json({**outcome.data, **({"warnings": warned} if warned else {})})
    else:
        click.echo(_shown(outcome.line))
        if outcome.then and not _manners.quiet:
            click.echo(f"next: {_shown(outcome.then)}", err=True)
    if "error" in outcome.data:
        print(f"btfkit: error: {outcome.data['error']['message']}", file=sys.stderr)  # noqa: T201
    _manners.code = outcome.code


def _print_json(data: Mapping[str, Any]) -> None:
    click.echo(json.dumps(plain(data), allow_nan=False))
