"""Options of commands: where networks run and where their weights are."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from slimsfm.weights import Runtime, use_runtime


@dataclass(frozen=True, kw_only=True)
class Networks:
    """Weights and device of learned methods."""

    weights: Path | None = None
    """Folder of weight files; by default $SLIMSFM_WEIGHTS, then the caches of the libraries."""

    device: Literal["auto", "cpu", "cuda"] | None = None
    """Where networks run; `auto` takes a GPU if there is one. The default is $SLIMSFM_DEVICE."""

    def apply(self) -> None:
        """Use these for all networks of the command, including those in its worker processes.

        Raises:
            InputError: The folder does not exist.
        """
        use_runtime(Runtime.from_environment(self.weights, self.device))
