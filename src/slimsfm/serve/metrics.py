"""Counters and durations as Prometheus reads them."""

import os
from collections import defaultdict
from collections.abc import Iterator, Mapping
from threading import Lock

_BUCKETS_S = 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 10.0
_MOST_SERIES = 2000  # names of maps and routes are few; what a client can invent is never a label
_PREFIX = "slimsfm_"

_HELP = {
    "requests_total": "Requests by route and status.",
    "request_seconds": "Time from a request's header to the end of its answer.",
    "localizations_total": "Images searched, by map and whether the object was found.",
    "frames_total": "Frames tracked, by map and state.",
    "frame_seconds": "Time from a frame's arrival to its answer.",
    "refused_total": "Requests that were refused, by code.",
    "sessions": "Clients that are tracked.",
    "waiting": "Jobs that wait for a worker.",
    "map_loads_total": "Maps read since the start.",
    "resident_memory_bytes": "Memory of the process.",
}

_Labels = tuple[tuple[str, str], ...]


class Metrics:
    """Counters and histograms, for any thread."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._counts: dict[tuple[str, _Labels], float] = defaultdict(float)
        self._buckets: dict[str, list[int]] = {}
        self._sums: dict[str, float] = defaultdict(float)

    def count(self, name: str, **labels: object) -> None:
        """Add one to a counter."""
        key = name, tuple((label, str(value)) for label, value in sorted(labels.items()))
        with self._lock:
            if key in self._counts or len(self._counts) < _MOST_SERIES:
                self._counts[key] += 1

    def observe(self, name: str, seconds: float) -> None:
        """Add a duration to a histogram."""
        with self._lock:
            buckets = self._buckets.setdefault(name, [0] * (len(_BUCKETS_S) + 1))
            buckets[sum(seconds > limit for limit in _BUCKETS_S)] += 1
            self._sums[name] += seconds

    def text(self, **gauges: float | int) -> str:
        """All of them in Prometheus' text format, with some values of the moment."""
        with self._lock:
            return "\n".join([*self._counters(), *self._histograms(), *_gauges(gauges)]) + "\n"

    def _counters(self) -> Iterator[str]:
        seen = set()
        for (name, labels), value in sorted(self._counts.items()):
            if name not in seen:
                yield from _header(name, "counter")
                seen.add(name)
            inner = ",".join(f'{label}="{_escaped(text)}"' for label, text in labels)
            yield f"{_PREFIX}{name}{{{inner}}} {value:g}"

    def _histograms(self) -> Iterator[str]:
        for name, buckets in sorted(self._buckets.items()):
            yield from _header(name, "histogram")
            total = 0
            for limit, number in zip((*_BUCKETS_S, "+Inf"), buckets, strict=True):
                total += number
                yield f'{_PREFIX}{name}_bucket{{le="{limit}"}} {total}'
            yield f"{_PREFIX}{name}_sum {self._sums[name]:.6f}"
            yield f"{_PREFIX}{name}_count {total}"


def _header(name: str, kind: str) -> Iterator[str]:
    yield f"# HELP {_PREFIX}{name} {_HELP[name]}"
    yield f"# TYPE {_PREFIX}{name} {kind}"


def _gauges(gauges: Mapping[str, float | int]) -> Iterator[str]:
    for name, value in gauges.items():
        yield from _header(name, "counter" if name.endswith("_total") else "gauge")
        yield f"{_PREFIX}{name} {value:g}"


def _escaped(text: str) -> str:
    return text.replace("\\", r"\\").replace('"', r"\"").replace("\n", r"\n")


def resident_bytes() -> int:
    """Memory of this process, 0 where the system does not say."""
    try:
        with open("/proc/self/statm", encoding="ascii") as file:
            return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return 0
