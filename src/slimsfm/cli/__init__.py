"""The command line. A command parses its options, calls the library and prints the result."""

import os
import signal
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from threading import current_thread, main_thread
from types import FrameType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from slimsfm.cli.options import Command

EXIT_BAD_INPUT = 2
EXIT_INTERRUPTED = 130  # 128 + SIGINT
EXIT_BROKEN_PIPE = 141  # 128 + SIGPIPE


@dataclass(frozen=True)
class Entry:
    """A command by the import paths of its parts, so that naming a command imports no other."""

    function: str
    """Relative to `slimsfm.cli`; its signature is the command line."""

    summary: str
    """What it does, in a few words."""

    types: Mapping[str, str] = field(default_factory=dict)
    """Dataclasses that stand in for the declared types of parameters, relative to `slimsfm`."""

    def load(self) -> "Command":
        """Import the command."""
        from slimsfm.cli.options import Command

        types = {name: _imported(f"slimsfm.{path}") for name, path in self.types.items()}
        return Command(_imported(f"slimsfm.cli.{self.function}"), types)


def _imported(path: str) -> Any:
    module, _, name = path.partition(":")
    return getattr(import_module(module), name)


def _benchmark(dataset: str, summary: str) -> Entry:
    return Entry("benchmark_command:benchmark", summary, {"dataset": f"datasets:{dataset}"})


COMMANDS = {
    "build": Entry("build_command:build_photos", "make a map from photos and videos"),
    "import": Entry("import_command:import_", "make a map from a COLMAP model or hloc output"),
    "reduce": Entry("reduce_command:reduce", "keep only what localization needs, and predict the loss"),
    "add": Entry("add_command:add_photos", "add photos to a map, without moving what it has"),
    "merge": Entry("merge_command:merge_maps", "join two maps of one place"),
    "forget": Entry("forget_command:forget_of", "drop what a map no longer needs, and say what that costs"),
    "localize": Entry("localize_command:localize", "estimate the camera poses of new images"),
    "track": Entry("track_command:track", "estimate the camera pose of every frame of a video"),
    "align": Entry("align_command:align_map", "give a map its unit and its place: meters, up, Earth"),
    "info": Entry("info_command:info", "show what a map contains"),
    "view": Entry("view_command:view", "show a map in the browser and localize images in it"),
    "serve": Entry("serve_command:serve", "localize images that phones, robots and programs send"),
    "frontier": Entry("frontier_command:frontier_of", "compare the ways to reduce a map"),
    "check": Entry("check_command:check", "find wrong poses and weak parts of a map, and repair them"),
    "graph": Entry("graph_command:graph", "compute which reference images localize which others"),
    "benchmark onepose": _benchmark("OnePose", "objects in OnePose's layout"),
    "benchmark onepose-lowtexture": _benchmark("OnePoseLowTexture", "objects in OnePose-LowTexture's layout"),
    "benchmark linemod": _benchmark("Linemod", "objects of LINEMOD as OnePose++ publishes them"),
    "benchmark bop": _benchmark("Bop", "a data set of the BOP challenge"),
    "benchmark colmap": _benchmark("Colmap", "a COLMAP model of mapping and query images"),
    "benchmark images": _benchmark("Images", "folders of photos; every n-th photo is a query"),
    "benchmark synthetic": _benchmark("Synthetic", "rendered objects with exact ground truth"),
    "benchmark --compare": Entry("benchmark_command:compare", "how two runs differ"),
    "report": Entry("report_command:report", "show a benchmark run on one HTML page"),
    "figures": Entry("figures_command:figures", "draw figures of a benchmark run for papers and slides"),
    "methods": Entry("methods_command:methods", "list extractors, matchers and strategies and their weights"),
    "export onnx": Entry("export_command:export_onnx", "a learned method as an ONNX file"),
    "export colmap": Entry("export_command:export_colmap", "the model of a map as COLMAP reads it"),
    "export hloc": Entry("export_command:export_hloc", "a map as hloc reads it"),
    "synthesize": Entry("synthesize_command:synthesize_objects", "render objects with exact ground truth"),
    "demo": Entry("demo_command:demo", "do all of this on objects that it renders itself"),
}
"""Every command. A name of two words is a subcommand."""

GROUPS = {
    "benchmark": "measure accuracy, speed and size of full and reduced maps",
    "export": "write a learned method or a map for other programs",
}
"""What the subcommands of a name have in common."""

_INTRODUCTION = """slimsfm makes COLMAP maps small and localizes images in them fast.

  slimsfm build PHOTOS -o MAP            or: slimsfm import COLMAP_MODEL -o MAP
  slimsfm reduce MAP -o SMALL            predicts what the reduction costs
  slimsfm localize SMALL IMAGES -o poses.json
  slimsfm serve SMALL                    the same for phones, robots and programs
  slimsfm benchmark images PHOTOS -o RESULTS
  slimsfm demo                           shows all of this in under 3 minutes

commands:
{commands}

`slimsfm COMMAND --help` explains a command."""


def main() -> None:
    """Run the command that the first argument names.

    A failure that the user can fix is one line on standard error and exit code 2.
    """
    for number in (signal.SIGTERM, signal.SIGALRM):
        signal.signal(number, _interrupt)
    sys.unraisablehook = _deliver_again
    if _asks_for_help(sys.argv[1:]):
        from slimsfm.cli.stand_ins import replace_libraries

        replace_libraries()
    try:
        code = run(sys.argv[1:])
        sys.stdout.flush()
    except BrokenPipeError:  # the reader, such as `head`, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = EXIT_BROKEN_PIPE
    sys.exit(code)


def run(arguments: Sequence[str]) -> int:
    """Run a command and return its exit code."""
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_INTRODUCTION.format(commands=_listed(_top_level())))
        return 0
    if arguments[0] == "--version":
        from importlib.metadata import version

        print(f"slimsfm {version('slimsfm')}")
        return 0
    from slimsfm.errors import SlimsfmError

    try:
        return _run_command(arguments)
    except SlimsfmError as error:
        from slimsfm.cli.parsing import printable, with_flags

        print(f"slimsfm: {printable(with_flags(str(error)))}", file=sys.stderr)
        return EXIT_BAD_INPUT
    except BrokenPipeError:
        raise
    except OSError as error:  # such as a name that is too long, or a circle of links
        print(
            f"slimsfm: {error.filename or 'a file'}: cannot be used ({error.strerror or error})",
            file=sys.stderr,
        )
        return EXIT_BAD_INPUT
    except KeyboardInterrupt as interruption:
        outcome = str(interruption) or "no incomplete output was left behind"
        print(f"slimsfm: interrupted; {outcome}", file=sys.stderr)
        return EXIT_INTERRUPTED


def _run_command(arguments: Sequence[str]) -> int:
    first, rest = arguments[0], list(arguments[1:])
    subcommands = [name for name in COMMANDS if name.startswith(f"{first} ")]
    if not subcommands:
        _check_name(first, [name.split()[0] for name in COMMANDS], "a command")
        return _execute(first, rest)
    if not rest or rest[0] in ("-h", "--help"):
        print(f"usage: slimsfm {first} {subcommands[0].split()[1]} ... [OPTIONS]\n\n{GROUPS[first]}:")
        print(_listed({name: COMMANDS[name].summary for name in subcommands}))
        print(f"\n`slimsfm {subcommands[0]} --help` explains one of them.")
        return 0
    _check_name(rest[0], [name.split()[1] for name in subcommands], f"a subcommand of {first}")
    return _execute(f"{first} {rest[0]}", rest[1:])


def _execute(name: str, arguments: Sequence[str]) -> int:
    """Run a command; its exit code is 0, unless it returns another one."""
    from slimsfm.cli.parsing import help_of, parse

    command = COMMANDS[name].load()
    if _asks_for_help(arguments):
        print(help_of(command, name))
        return 0
    call = parse(command, name, arguments)
    _take_signal_back()
    from slimsfm.cli.output import quiet, tidy_warnings
    from slimsfm.files import remove_abandoned

    remove_abandoned()
    tidy_warnings()
    with quiet():
        return call() or 0


def _check_name(name: str, known: Sequence[str], kind: str) -> None:
    from slimsfm.cli.parsing import nearest
    from slimsfm.errors import InputError

    if name not in known:
        hint = nearest(name, known) or f"; choose one of {', '.join(dict.fromkeys(known))}"
        raise InputError(f"{name!r} is not {kind}{hint}")


def _asks_for_help(arguments: Sequence[str]) -> bool:
    return "-h" in arguments or "--help" in arguments


def _top_level() -> dict[str, str]:
    """The first words of all commands with their summaries."""
    return {name.split()[0]: GROUPS.get(name.split()[0], entry.summary) for name, entry in COMMANDS.items()}


def _listed(summaries: Mapping[str, str]) -> str:
    width = max(len(name) for name in summaries)
    return "\n".join(f"  {name:<{width}}  {summary}" for name, summary in summaries.items())


def _take_signal_back() -> None:
    """Restore Python's handler of SIGTERM: importing pycolmap makes the signal end the process at once."""
    handler = signal.getsignal(signal.SIGTERM)
    if handler is not None and current_thread() is main_thread():
        signal.signal(signal.SIGTERM, handler)


def _deliver_again(ignored: "sys.UnraisableHookArgs") -> None:
    """Raise an interruption again if it fell into a destructor, where Python must ignore it."""
    if issubclass(ignored.exc_type, KeyboardInterrupt):
        signal.setitimer(signal.ITIMER_REAL, 0.01)
    else:
        sys.__unraisablehook__(ignored)


def _interrupt(_signum: int, _frame: FrameType | None) -> None:
    raise KeyboardInterrupt
