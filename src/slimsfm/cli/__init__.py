"""The command line: one file a command, each of which parses, calls the library and prints."""

import signal
import sys
from importlib import import_module
from threading import current_thread, main_thread
from types import FrameType

COMMANDS = {
    "build": "photos -> map",
    "import": "COLMAP model, hloc output -> map",
    "info": "what is in a map",
    "graph": "which reference images localize which others",
    "reduce": "map -> slim map",
    "frontier": "what a map can be reduced to, and what that costs",
    "localize": "poses of new images",
    "track": "poses of a video, frame by frame",
    "view": "a map in the browser, before and after; localizes images by a click",
    "benchmark": "speed and accuracy, full against slim",
    "report": "a benchmark on one page: what is kept, what it costs, where it fails",
    "figures": "figures of a benchmark, for papers and slides",
    "methods": "extractors, matchers and strategies there are, and their weights",
    "export": "a network as an ONNX file, a map for hloc",
    "synthesize": "textured objects with exact ground truth",
    "demo": "all of it, on objects it makes itself",
}
"""Each is the module `slimsfm.cli.NAME_command`; naming one imports none of the others."""

_INTRODUCTION = """slimsfm makes a Structure-from-Motion model small and localizing in it fast,
and says what that costs.

  slimsfm demo                          see it work, in under 3 minutes
  slimsfm build PHOTOS -o MAP           or: slimsfm import COLMAP_MODEL -o MAP
  slimsfm reduce MAP -o SMALL           keep what is enough to localize
  slimsfm localize SMALL IMAGES -o poses.json
  slimsfm benchmark images PHOTOS -o RESULTS

Commands: {commands}. Each explains itself with --help."""


def main() -> None:
    """Run the command that the first argument names. Exit code 2 and one line say what a user can mend."""
    for number in (signal.SIGTERM, signal.SIGALRM):
        signal.signal(number, _interrupt)
    sys.unraisablehook = _deliver_again
    sys.exit(run(sys.argv[1:]))


def run(arguments: list[str]) -> int:
    """Run a command and return its exit code."""
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_INTRODUCTION.format(commands=", ".join(COMMANDS)))
        return 0
    name, *rest = arguments
    if name == "--version":
        from importlib.metadata import version

        print(f"slimsfm {version('slimsfm')}")
        return 0
    if name not in COMMANDS:
        return _fail(f"{name!r} is no command; there are {', '.join(COMMANDS)}")
    from slimsfm.errors import SlimsfmError

    try:
        from slimsfm.cli.output import quiet

        command = import_module(f"slimsfm.cli.{name}_command")
        _take_signal_back()
        with quiet():
            command.main(rest)
    except SlimsfmError as error:
        return _fail(str(error))
    except SystemExit as end:  # --help
        return int(end.code or 0)
    except KeyboardInterrupt as interruption:
        what_now = str(interruption) or "nothing half-made was left behind"
        print(f"slimsfm: interrupted; {what_now}", file=sys.stderr)
        return 130
    return 0


def _fail(message: str) -> int:
    print(f"slimsfm: {message}", file=sys.stderr)
    return 2


def _take_signal_back() -> None:
    """Importing pycolmap makes SIGTERM end the process on the spot: put back what Python had for it."""
    handler = signal.getsignal(signal.SIGTERM)
    if handler is not None and current_thread() is main_thread():
        signal.signal(signal.SIGTERM, handler)


def _deliver_again(ignored: "sys.UnraisableHookArgs") -> None:
    """Raise an interruption anew that fell into a destructor, where Python must ignore it."""
    if issubclass(ignored.exc_type, KeyboardInterrupt):
        signal.setitimer(signal.ITIMER_REAL, 0.01)
    else:
        sys.__unraisablehook__(ignored)


def _interrupt(_signum: int, _frame: FrameType | None) -> None:
    raise KeyboardInterrupt
