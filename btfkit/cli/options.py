"""Values of options that several verbs share, and the one file that goes without saying."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, final

import click
from click.shell_completion import CompletionItem

from btfkit import settings
from btfkit.errors import BtfkitError
from btfkit.remote import Location, located


@final
class SliceType(click.ParamType[slice]):
    """`A:B:S` as a slice."""

    name = "A:B:S"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> slice:
        if isinstance(value, slice):
            return value
        parts = str(value).split(":")
        if len(parts) > 3 or not all(re.fullmatch(r"-?\d*", part) for part in parts):
            self.fail(f"{value!r} is no slice; expected A:B or A:B:S", param, ctx)
        numbers = [int(part) if part not in ("", "-") else None for part in parts]
        if len(numbers) == 1 and numbers[0] is not None:
            stop = numbers[0] + 1
            return slice(numbers[0], stop if stop else None)
        if numbers[2:] == [0]:
            self.fail(f"{value!r} has step 0", param, ctx)
        return slice(*numbers)


@final
class WindowType(click.ParamType[tuple[slice, slice]]):
    """`R0:R1,C0:C1` as a pair of slices."""

    name = "R0:R1,C0:C1"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[slice, slice]:
        if isinstance(value, tuple):
            return value
        match = re.fullmatch(r"(\d*):(\d*),(\d*):(\d*)", str(value))
        if not match:
            self.fail(f"{value!r} is no window; expected R0:R1,C0:C1", param, ctx)
        r0, r1, c0, c1 = (int(part) if part else None for part in match.groups())
        return slice(r0, r1), slice(c0, c1)


@final
class NumbersType(click.ParamType[tuple[Any, ...]]):
    """Numbers between commas (or an x), a fixed count of them."""

    def __init__(self, name: str, kind: type, separator: str = ",") -> None:
        self.name = name
        self._kind, self._separator = kind, separator
        self._count = len(name.split(separator))

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[Any, ...]:
        if isinstance(value, tuple):
            return value
        try:
            numbers = tuple(self._kind(part) for part in str(value).split(self._separator))
        except ValueError:
            numbers = ()
        if len(numbers) != self._count:
            self.fail(f"{value!r}; expected {self.name}", param, ctx)
        return numbers


@final
class FiniteType(click.FloatRange):
    """A number of a range; neither infinite nor NaN, which compares with no end of it."""

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        number: float = click.FLOAT.convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value!r} is not a finite number", param, ctx)
        return super().convert(value, param, ctx)


@final
class DurationType(click.ParamType[float]):
    """`60s`, `5m`, `1m30s`, `1.5h` or plain seconds, as seconds."""

    name = "60s|5m|1m30s"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        if isinstance(value, float):
            return value
        number = r"(\d+(?:\.\d+)?)"
        match = re.fullmatch(
            rf"(?:{number}\s*h\s*)?(?:{number}\s*m\s*)?(?:{number}\s*s?)?", str(value)
        )
        parts = [float(part or 0) for part in match.groups()] if match else [0.0]
        seconds = sum(part * unit for part, unit in zip(parts, (3600, 60, 1), strict=False))
        if seconds <= 0:
            self.fail(f"{value!r} is no time; expected like 60s, 5m or 1m30s", param, ctx)
        return seconds


@final
class SettingType(click.ParamType[tuple[str, str]]):
    """`key=value` as a pair."""

    name = "key=value"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[str, str]:
        if isinstance(value, tuple):
            return value
        try:
            return settings.split(str(value))
        except ValueError as error:
            self.fail(str(error), param, ctx)


@final
class LocationType(click.ParamType[Location]):
    """A path, or the URL of a store that fsspec reaches."""

    name = "path"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> Location:
        return located(value)

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        return [CompletionItem(incomplete, type="file")]


def completed(names: Callable[[], Iterable[str]]) -> Callable[..., list[str]]:
    """What a shell offers for an option: those of `names()` that begin as what is typed."""

    def offered(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[str]:
        return [name for name in names() if name.startswith(incomplete)]

    return offered


def fitted_models() -> Iterable[str]:
    """Models that can be fitted."""
    from btfkit.materials import MODELS

    return (name for name in MODELS if name != "composite")


def source_formats() -> Iterable[str]:
    """Formats that can be read."""
    from btfkit.io import FORMATS

    return FORMATS


def out_option(what: str) -> Callable[..., Any]:
    """The `-o OUT` option of a verb."""
    return click.option("-o", "--out", type=click.Path(path_type=Path), help=f"{what}.")


def location_option(what: str) -> Callable[..., Any]:
    """The `-o OUT` option of a verb that writes a store, on disk or in an object store."""
    return click.option("-o", "--out", type=LocationType(), help=f"{what}.")


force_option = click.option("--force", is_flag=True, help="Replace an existing output.")
seed_option = click.option("--seed", type=int, default=0, show_default=True, help="Repeat a run.")


def the_only(found: Iterable[Path], *, what: str, remedy: str, first: str | None = None) -> Path:
    """The one path of `found`; with none or several, an error that lists them.

    Args:
        found: what lies there. what: its name, in the plural.
        remedy: how one of several is named. first: what makes one where there is none.

    Raises:
        BtfkitError: not exactly one.
    """
    paths = sorted(found)
    if len(paths) == 1:
        return paths[0]
    if not paths and first:
        remedy = f"first: {first}"
    listing = ", ".join(path.name for path in paths) or "none"
    raise BtfkitError(f"{what} in this folder: {listing}; expected exactly one", remedy=remedy)


def stem(path: Location) -> str:
    """Name of a source without what the toolkit or its format appends."""
    name = path.resolve().name if isinstance(path, Path) else path.name
    for suffix in (".btf.zarr", ".safetensors", *Path(name).suffixes[-1:]):
        name = name.removesuffix(suffix)
    return name
