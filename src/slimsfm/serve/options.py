"""What a server serves, to whom, and how much of it."""

from dataclasses import dataclass, field
from pathlib import Path

from slimsfm.execution import num_cores
from slimsfm.localization import LocalizationOptions
from slimsfm.tracking import TrackerOptions

LIVE_TRACKING = TrackerOptions(search_every=3)
"""How clients are tracked by default: an object that comes back is sought in every third whole frame, because
somebody waits for it."""


@dataclass(frozen=True, kw_only=True)
class ServeLimits:
    """How much a server takes on, so that nobody can stop it from answering others."""

    workers: int = field(default_factory=num_cores)
    """Number of threads that localize and track."""

    max_body_bytes: int = 8 * 2**20
    """Largest body of a request and largest frame."""

    max_waiting: int = 64
    """Largest number of requests that wait for a worker; more are refused."""

    max_requests: int = 128
    """Largest number of requests that are received, worked on or answered at a time."""

    deadline_s: float = 10.0
    """Time after which nobody needs an answer. What would miss it is refused at once."""

    receive_s: float = 10.0
    """Longest time that a request, its headers and then its body, may take to arrive."""

    requests_per_second: float = 50.0
    """Rate of images that a client may send for localization in the long run."""

    burst: int = 100
    """Number of images that a client may send at once."""

    max_sessions: int = 16
    """Largest number of clients that are tracked at a time."""

    sessions_per_client: int = 12
    """Largest number of them with one address."""

    idle_s: float = 30.0
    """Time without a frame after which a session ends."""

    reload_every_s: float = 1.0
    """Time between looks for maps whose folder was replaced."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not value > 0:
                raise ValueError(f"{name} must be positive, got {value}")


@dataclass(frozen=True, kw_only=True)
class ServeOptions:
    """What a server serves and to whom."""

    maps: tuple[Path, ...]
    """Folders of maps."""

    token: str = ""
    """What every request but those for the page must carry. Empty: only this machine reaches the server, and
    requests must name it as their host."""

    origins: tuple[str, ...] = ()
    """Origins of foreign pages that may send requests, such as `https://example.org`."""

    record: Path | None = None
    """Folder that images and their poses are written to. None: images are neither kept nor logged."""

    model: Path | None = None
    """GLB, OBJ or PLY that the page draws at the first map's object."""

    anchor: Path | None = None
    """Where the model is in the map, see `models.read_anchor`. None: in the center of the box, as large."""

    film: Path | None = None
    """Video that the page can play instead of a camera."""

    authority: Path | None = None
    """Certificate of the authority that made the server's, for phones to fetch."""

    localization: LocalizationOptions = LocalizationOptions()
    """How images are localized."""

    tracker: TrackerOptions = LIVE_TRACKING
    """How frames are tracked."""

    limits: ServeLimits = field(default_factory=ServeLimits)
    """How much is taken on."""

    def __post_init__(self) -> None:
        if self.anchor and not self.model:
            raise ValueError("anchor goes with a model; give `model` too")
