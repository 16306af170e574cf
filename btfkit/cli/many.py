"""Several sources of one verb, on a cluster: their names, and what became of each."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from btfkit.cli.bar import Bar
from btfkit.cli.outcome import DONE, FAILED, Outcome, error_line
from btfkit.remote import Location

if TYPE_CHECKING:
    from btfkit.cluster import Ended

cluster_option = click.option(
    "--cluster",
    metavar="ADDRESS|local:N",
    help="Give several sources to Dask's workers, or to N processes here.",
)


def the_one(sources: Sequence[Any], what: str) -> Any:
    """The only source of a verb that runs here; None where none was named.

    Raises:
        UsageError: there are several.
    """
    if len(sources) > 1:
        raise click.UsageError(
            f"{len(sources)} {what}; one at a time, or several with --cluster local:N"
        )
    return sources[0] if sources else None


def outputs(
    sources: Iterable[Location], out: Location | None, name: Callable[[Location], Path]
) -> dict[str, Location]:
    """Every source, absolute, with what it becomes.

    Args:
        sources: at least one.
        out: of the only source its output; of several the folder of theirs, made where missing.
        name: of an output, by its source.

    Raises:
        ValueError: two sources would become one and the same.
    """
    from btfkit.remote import Remote

    given = list(sources)
    if not given:
        raise click.UsageError("--cluster is for sources by name; name them")
    found: dict[str, Location] = {}
    by: dict[str, str] = {}
    for source in given:
        target: Location = Path.cwd() / name(source)
        if isinstance(out, Remote):
            target = out if len(given) == 1 else Remote(f"{out}/{name(source).name}")
        elif out is not None and len(given) == 1:
            target = out.absolute()
        elif out is not None:
            out.mkdir(exist_ok=True)
            target = out.absolute() / name(source).name
        absolute = str(source.absolute() if isinstance(source, Path) else source)
        if str(target) in by:
            raise ValueError(f"{by[str(target)]} and {absolute} would both become {target}")
        by[str(target)] = absolute
        found[absolute] = target
    return found


def over(
    where: str,
    tasks: Mapping[str, Sequence[Any] | Ended],
    function: Callable[..., Outcome],
    bar: Bar,
) -> Outcome:
    """Run `function(source, *arguments)` for every source on a cluster.

    Args:
        where: of `--cluster`.
        tasks: sources with the further arguments of each, or how they ended before they began.
        function: of a module; whatever it writes is whole or absent, and may be there already
            where a worker was lost as it ended.
    """
    from btfkit.cluster import Ended, connected

    ended = {source: how for source, how in tasks.items() if isinstance(how, Ended)}
    given = {source: each for source, each in tasks.items() if not isinstance(each, Ended)}
    if not given:
        return told(ended)
    bar.phase("connecting")
    with connected(where) as cluster:
        bar.phase("working")
        bar(len(ended), len(tasks))
        for source, arguments in given.items():

            def note(how: Ended, source: str = source) -> None:
                ended[source] = how
                bar(len(ended), len(tasks))

            cluster.submit(function, source, *arguments, then=note)
        cluster.drain()
    return told({source: ended[source] for source in tasks})


def told(ended: Mapping[str, Ended]) -> Outcome:
    """What became of a list: done ones with what they would say alone, failed ones by name."""
    done = [
        {"source": source, **how.value.data, **_warned(how)}
        for source, how in ended.items()
        if how.error is None
    ]
    failed = [
        {"source": source, "type": type(how.error).__name__, "message": error_line(how.error)}
        for source, how in ended.items()
        if how.error is not None
    ]
    lines = [how.value.line for how in ended.values() if how.error is None]
    lines += [f"failed {each['source']}: {each['message']}" for each in failed]
    data: dict[str, Any] = {"done": done, "failed": failed}
    if not failed:
        return Outcome("\n".join(lines), data, code=DONE)
    return Outcome("\n".join(lines), {**data, "error": several(failed, len(ended))}, code=FAILED)


def several(failed: Sequence[Mapping[str, str]], total: int) -> dict[str, str]:
    """The one error of a list in which some failed."""
    names = ", ".join(Path(each["source"]).name for each in failed)
    return {"type": "Several", "message": f"{len(failed)} of {total} failed: {names}"}


def _warned(how: Ended) -> dict[str, Any]:
    return {"warnings": how.warnings} if how.warnings else {}
