"""On what a benchmark was measured."""

import os
import platform
import shutil
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

_PACKAGES = (
    *("slimsfm", "numpy", "scipy", "pycolmap", "poselib", "opencv-python-headless"),
    *("torch", "kornia", "transformers", "onnxruntime"),
)


def environment() -> dict[str, str]:
    """Versions of what computes, and the machine; what is not there is left out."""
    found = {package: number for package in _PACKAGES if (number := _version(package))}
    return {
        **found,
        "python": platform.python_version(),
        "system": platform.platform(),
        "cpu": _cpu(),
        "cores": str(len(os.sched_getaffinity(0))),
        "gpu": _gpu(),
    }


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def _gpu() -> str:
    """As the driver's own tool names it; asking torch would cost seconds where nobody needs it."""
    tool = shutil.which("nvidia-smi")
    if tool is None:
        return "none"
    asked = [tool, "--query-gpu=name", "--format=csv,noheader"]
    found = subprocess.run(asked, capture_output=True, text=True, check=False)
    return ", ".join(found.stdout.split("\n")[:-1]) or "none"
