"""The command line: one module a verb, loaded when it is asked for."""

from __future__ import annotations

import importlib
import os
import sys

import click

# numpy reads it when it is loaded. OpenBLAS's threads spin at barriers: with both cores taken,
# products of small matrices ran 5 to 160 times slower on two of them than on one. Kernels and
# torch, which do the large work, have threads of their own.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Verb -> module with a function of the verb's name, and the line that `btfkit --help` shows.
VERBS: dict[str, tuple[str, str]] = {
    "capture": ("btfkit.cli.capture", "Run a measurement on a rig, or on its twin."),
    "ingest": ("btfkit.cli.ingest", "Read any measured source into one native store."),
    "calibrate": ("btfkit.cli.calibrate", "Calibrate a sequence; find lights in photographs."),
    "convert": ("btfkit.cli.convert", "Write a store in an interchange format."),
    "fit": ("btfkit.cli.fit", "Fit a model to a BTF, a relief or a query file."),
    "propagate": ("btfkit.cli.propagate", "Carry a fitted NeuBTF onto a guidance image."),
    "tile": ("btfkit.cli.tile", "Make an image, a BTF or a NeuBTF tile."),
    "heightfield": ("btfkit.cli.heightfield", "The relief that a BTF implies, or a model has."),
    "eval": ("btfkit.cli.eval", "Errors of a model on a BTF or a query file."),
    "query": ("btfkit.cli.query", "Answer a query file with a model."),
    "render": ("btfkit.cli.render", "A picture of a material on a simple shape."),
    "view": ("btfkit.cli.view", "A page that shows a model or a BTF in any browser."),
    "export": ("btfkit.cli.export", "A model as files that other programs take."),
    "synth": ("btfkit.cli.synth", "Make a procedural material with known relief."),
    "bench": ("btfkit.cli.bench", "Time against error of all models on this machine."),
    "info": ("btfkit.cli.info", "What a file is; without a path: versions and kernels."),
}


class _Verbs(click.Group):
    """A group that knows its verbs by name and imports one when it is used."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(VERBS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in VERBS:
            return None
        module = importlib.import_module(VERBS[cmd_name][0])
        command: click.Command = getattr(module, f"{cmd_name}_verb")
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        from btfkit.errors import unknown

        if args and args[0] not in VERBS and not args[0].startswith("-"):
            ctx.fail(unknown("verb", args[0], VERBS))
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Verbs"):
            formatter.write_dl([(name, line) for name, (_, line) in VERBS.items()])


@click.group(cls=_Verbs, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="btfkit", prog_name="btfkit")
def btfkit() -> None:
    """Measured materials, from photographs to neural materials in a renderer.

    \b
    btfkit ingest folder
    btfkit fit --model neubtf
    btfkit propagate guidance.png
    """  # noqa: D301


def main() -> None:
    """Entry point of the `btfkit` command."""
    from btfkit.cli.outcome import run

    sys.exit(run(btfkit, sys.argv[1:]))
