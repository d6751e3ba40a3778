"""Methods as ONNX files, by name."""

from pathlib import Path

from slimsfm.errors import InputError
from slimsfm.features.methods import importing, resolve
from slimsfm.files import replacing

# Paths, not functions: naming a method must not import what it needs.
EXPORTABLE = {
    "aliked-n16": "slimsfm.features.aliked:exportable",
    "aliked-t16": "slimsfm.features.aliked:exportable",
    "disk": "slimsfm.features.disk:exportable",
    "lightglue-aliked": "slimsfm.features.lightglue:exportable",
    "lightglue-disk": "slimsfm.features.lightglue:exportable",
    "lightglue-sift": "slimsfm.features.lightglue:exportable",
    "lightglue-superpoint": "slimsfm.features.lightglue:exportable",
    "superpoint": "slimsfm.features.superpoint:exportable",
}
"""What gives what an ONNX file holds, by the name that the method's weights have."""


def export_method(method: str, path: Path, *, overwrite: bool = False) -> None:
    """Write the network of a method, with its trained weights, as an ONNX file.

    It holds the part that costs the time and is a graph of tensors: of an extractor what sees the image, not
    what picks keypoints; of LightGlue all of it, without stopping early.

    Raises:
        InputError: No such method can be exported, its weights are missing, or what it needs is.
        OutputError: The file cannot be written.
    """
    if method not in EXPORTABLE:
        known = ", ".join(EXPORTABLE)
        raise InputError(f"{method!r} cannot be exported; what can is {known}")
    with importing(f"method {method!r}"):
        make = resolve(EXPORTABLE[method])
        write_onnx = resolve("slimsfm.networks.onnx:write_onnx")
    part = make(method)
    with replacing(path, overwrite=overwrite) as partial:
        write_onnx(part, method, partial)
