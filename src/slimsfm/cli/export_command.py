"""`slimsfm export`."""

from collections.abc import Sequence
from typing import Annotated

import tyro

from slimsfm.cli.networks import Networks
from slimsfm.cli.output import Flat, OutputPath, Stopwatch, console, finish, parse, size
from slimsfm.errors import OutputError
from slimsfm.features.exporting import EXPORTABLE, export_method
from slimsfm.files import check_writable

_MethodName = Annotated[
    tyro.conf.Positional[str], tyro.conf.arg(metavar="METHOD", help=f"One of {', '.join(EXPORTABLE)}.")
]


def export(
    method: _MethodName,
    /,
    output: OutputPath,
    networks: Annotated[Networks, Flat] = Networks(),
    overwrite: bool = False,
) -> None:
    """Export the network of a method as an ONNX file, by which it runs on the CPU.

    It does so wherever the file lies in the folder of weights, named METHOD.onnx.

    Args:
        method: Which.
        output: Where the file is written.
        networks: Where weights are.
        overwrite: Replace what is there.
    """
    watch = Stopwatch()
    networks.apply()
    if output.is_dir():
        raise OutputError(f"{output}: is a folder; name a file, such as {output / method}.onnx")
    check_writable(output, overwrite=overwrite)
    export_method(method, output, overwrite=overwrite)
    finish(f"{output}: {method}, {size(output.stat().st_size)}", watch)
    console.print(f"runs {method} on the CPU as {method}.onnx in the folder of weights", style="dim")


def main(arguments: Sequence[str]) -> None:
    """Run the command."""
    parse(export, arguments)
