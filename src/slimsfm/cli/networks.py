"""Where networks run and where their weights are, as options of a command."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from slimsfm.weights import DEVICE, FOLDER, weights_folder


@dataclass(frozen=True, kw_only=True)
class Networks:
    """Learned methods."""

    weights: Path | None = None
    """Folder of weight files; else the one that SLIMSFM_WEIGHTS names, else the libraries' caches."""

    device: Literal["auto", "cpu", "cuda"] | None = None
    """Where networks run; auto: on a GPU if there is one. Else as SLIMSFM_DEVICE says."""

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
