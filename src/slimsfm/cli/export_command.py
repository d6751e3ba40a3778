"""`slimsfm export`."""

from pathlib import Path
from typing import Annotated

from slimsfm.cli.arguments import Networks
from slimsfm.cli.options import Advanced, Argument, MapPath, OutputPath
from slimsfm.cli.output import Stopwatch, check_output, console, finish, plural, size
from slimsfm.errors import OutputError
from slimsfm.features.registry import export_method
from slimsfm.files import check_writable
from slimsfm.mapping.hloc import read_query_names, write_hloc
from slimsfm.mapping.io import read_map


def export_onnx(
    method: Annotated[str, Argument("METHOD")],
    /,
    output: OutputPath,
    networks: Annotated[Networks, Advanced()] = Networks(),
    overwrite: bool = False,
) -> None:
    """Export the network of a method as an ONNX file.

    Put the file into the folder of weights as METHOD.onnx, and the method runs from it on the CPU.

    Args:
        method: One of `slimsfm methods`; an unknown name lists those that can be exported.
        output: The file to write.
        networks: Where the weights are.
        overwrite: Replace an existing file.
    """
    watch = Stopwatch()
    networks.apply()
    if output.is_dir():
        raise OutputError(f"{output}: is a folder; name a file, such as {output / method}.onnx")
    check_writable(output, overwrite=overwrite)
    export_method(method, output, overwrite=overwrite)
    finish(f"{output}: {method}, {size(output.stat().st_size)}", watch)
    console.print(
        f"put it into the folder of weights as {method}.onnx to run {method} from it on the CPU", style="dim"
    )


def export_hloc(
    map: MapPath, /, output: OutputPath, queries: Path | None = None, overwrite: bool = False
) -> None:
    """Export a map for hloc's `match_features` and `localize_sfm`.

    The output folder contains sfm/, features.h5, references.txt, matches.h5 if the map has matches, and
    pairs-queries.txt if queries are given: every query with every image of the map.

    Args:
        map: A map whose images have features.
        output: The folder to write.
        queries: A folder of images, or a text file with one name per line, such as hloc's list of queries.
        overwrite: Replace an existing output.
    """
    watch = Stopwatch()
    check_output(output, map, queries, overwrite=overwrite)
    names = read_query_names(queries) if queries else []
    exported = read_map(map)
    write_hloc(exported, output, names, overwrite=overwrite)
    images, points = plural(len(exported.images), "image"), plural(len(exported.point3D_ids), "point")
    number = plural(len(names) * len(exported.images), "pair")
    pairs = f", {number} of {plural(len(names), 'query', 'queries')}" if queries else ""
    finish(f"{output}: {images}, {points}{pairs}", watch)
    console.print(
        f"in hloc, pass the pairs and features_ref={output / 'features.h5'} to match_features, "
        f"then {output / 'sfm'} to localize_sfm",
        style="dim",
    )
