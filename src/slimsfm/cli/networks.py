"""Where networks run and where their weights are, as options of a command."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from slimsfm.weights import Runtime, use_runtime


@dataclass(frozen=True, kw_only=True)
class Networks:
    """Learned methods."""

    weights: Path | None = None
    """Folder of weight files; else the one that SLIMSFM_WEIGHTS names, else the libraries' caches."""

    device: Literal["auto", "cpu", "cuda"] | None = None
    """Where networks run; auto: on a GPU if there is one. Else as SLIMSFM_DEVICE says."""

    def apply(self) -> None:
        """Use these for all networks of the command, including those in its worker processes.

        Raises:
            InputError: The folder does not exist.
        """
        use_runtime(Runtime.from_environment(self.weights, self.device))
