"""`slimsfm export`."""

from pathlib import Path
from typing import Annotated

from slimsfm.cli.arguments import Networks
from slimsfm.cli.options import Advanced, Argument, MapPath, OutputPath
from slimsfm.cli.output import Stopwatch, check_output, console, finish, plural, size
from slimsfm.errors import OutputError
from slimsfm.features.registry import export_method
from slimsfm.files import replacing
from slimsfm.image_files import named
from slimsfm.mapping.hloc import read_query_names, write_hloc
from slimsfm.mapping.io import read_map
from slimsfm.mapping.map import Map
from slimsfm.mapping.orientation import mirrored_images, stored_model, turns_to_stored


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
    check_output(output, overwrite=overwrite)
    export_method(method, output, overwrite=overwrite)
    finish(f"{output}: {method}, {size(output.stat().st_size)}", watch)
    console.print(
        f"put it into the folder of weights as {method}.onnx to run {method} from it on the CPU", style="dim"
    )


def export_colmap(map: MapPath, /, output: OutputPath, overwrite: bool = False) -> None:
    """Export the model of a map for COLMAP, in the pixels of the image files as they are stored.

    COLMAP ignores the EXIF orientation of photos. The sparse/ of a map of upright pictures fits only photos
    without one; the exported model fits all. Images whose orientation mirrors them are left out.

    Args:
        map: A map.
        output: The folder of the model.
        overwrite: Replace an existing output.
    """
    watch = Stopwatch()
    check_output(output, map, overwrite=overwrite)
    exported = read_map(map)
    model = stored_model(exported)
    with replacing(output, overwrite=overwrite) as partial:
        partial.mkdir(parents=True)
        model.write(partial)
    _print_left_out(exported)
    images, points = plural(model.num_images(), "image"), plural(model.num_points3D(), "point")
    finish(f"{output}: {images}, {points}", watch)


def _print_left_out(exported: Map) -> None:
    if mirrored := mirrored_images(exported):
        text = named("image(s) left out, because their EXIF orientation mirrors them", mirrored)
        console.print(text, style="yellow")


def export_hloc(
    map: MapPath, /, output: OutputPath, queries: Path | None = None, overwrite: bool = False
) -> None:
    """Export a map for hloc's `match_features` and `localize_sfm`.

    hloc ignores the EXIF orientation of photos, and so does what is exported, as `export colmap` does.

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
    _print_left_out(exported)
    num_images = len(turns_to_stored(exported))
    images, points = plural(num_images, "image"), plural(len(exported.point3D_ids), "point")
    number = plural(len(names) * num_images, "pair")
    pairs = f", {number} of {plural(len(names), 'query', 'queries')}" if queries else ""
    finish(f"{output}: {images}, {points}{pairs}", watch)
    console.print(
        f"in hloc, pass the pairs and features_ref={output / 'features.h5'} to match_features, "
        f"then {output / 'sfm'} to localize_sfm",
        style="dim",
    )
