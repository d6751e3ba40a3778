"""Which features and which matcher a benchmark maps and localizes with."""

from dataclasses import dataclass

from slimsfm.features.registry import EXTRACTORS, MATCHERS, plugins


@dataclass(frozen=True)
class Method:
    """Local features, and what matches them."""

    extractor: str
    """Name of the extractor, see `slimsfm methods`."""

    matcher: str | None = None
    """Name of the matcher; None: nearest neighbours, or whole images where there are no keypoints."""

    def __str__(self) -> str:
        return self.extractor if self.matcher is None else f"{self.extractor}+{self.matcher}"


def parse_method(text: str) -> Method:
    """Read a method from its name: an extractor, or an extractor and a matcher as in `aliked+lightglue`.

    Raises:
        ValueError: There is no such extractor or matcher.
    """
    extractor, plus, matcher = text.partition("+")
    extractors, matchers = {**EXTRACTORS, **plugins("extractor")}, {**MATCHERS, **plugins("matcher")}
    if extractor not in extractors:
        raise ValueError(f"methods must be made of {', '.join(extractors)}, got {text!r}")
    if plus and matcher not in matchers:
        raise ValueError(f"the matcher of a method must be one of {', '.join(matchers)}, got {text!r}")
    return Method(extractor, matcher or None)
