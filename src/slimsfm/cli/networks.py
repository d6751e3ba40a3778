"""Options of commands: where networks run and where their weights are."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from slimsfm.weights import DEVICE, FOLDER, weights_folder


@dataclass(frozen=True, kw_only=True)
class Networks:
    """Weights and device of learned methods."""

    weights: Path | None = None
    """Folder of weight files; by default $SLIMSFM_WEIGHTS, then the caches of the libraries."""

    device: Literal["auto", "cpu", "cuda"] | None = None
    """Where networks run; `auto` takes a GPU if there is one. The default is $SLIMSFM_DEVICE."""

    def apply(self) -> None:
        """Make these hold for this process and those that it starts.

        Raises:
            InputError: There is no such folder.
        """
        if self.weights is not None:
            os.environ[FOLDER] = str(self.weights)
        if self.device is not None:
            os.environ[DEVICE] = self.device
        weights_folder()
