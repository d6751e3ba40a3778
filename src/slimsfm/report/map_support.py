"""What the report says about the maps themselves: what supports them, and what contradicts them."""

from collections.abc import Mapping
from html import escape

from slimsfm.evaluation.formats import map_warnings
from slimsfm.evaluation.results import MappedObject, ObjectResult, Run
from slimsfm.mapping.quality import ModelQuality


def warnings_html(run: Run, anchors: Mapping[str, str]) -> str:
    """A warning that names the doubted maps of a run; empty if there are none.

    Args:
        run: The run.
        anchors: Link targets of the objects, by name.
    """
    items = "".join(
        f'<li><a href="#{anchors[name]}">{escape(name)}</a>, {escape(method)}: {escape(why)}</li>'
        for name, method, why in map_warnings(run.objects)
    )
    if not items:
        return ""
    title = "Poses may be wrong: maps are in doubt"
    return f'<section class="card failed"><h2>{title}</h2><ul>{items}</ul></section>'


def support_html(mapped: MappedObject) -> str:
    """What supports and contradicts the full map of an object, and what was skipped or guessed."""
    facts = _facts(mapped.quality) if mapped.quality else {"Support": "not measured: no verified matches"}
    items = "".join(f"<dt>{name}</dt><dd>{escape(value)}</dd>" for name, value in facts.items())
    notes = "".join(f"<dd>{escape(note)}</dd>" for note in mapped.notes)
    return f'<dl class="support">{items}{"<dt>Notes</dt>" * bool(notes)}{notes}</dl>'


def left_out_html(result: ObjectResult) -> str:
    """The images that were left out because their true poses are contradicted; empty if there are none."""
    if not result.contradicted:
        return ""
    items = "".join(f"<li>{escape(why)}</li>" for why in result.contradicted.values())
    count = len(result.contradicted)
    title = f"{count} image{'s' * (count != 1)} left out: the others contradict the true poses"
    return f"<details><summary>{title}</summary><ul>{items}</ul></details>"


def _facts(quality: ModelQuality) -> dict[str, str]:
    agreeing = quality.verified_pairs - quality.contradicted_pairs
    focal_lengths = [
        f"{focal:.2f} ({quality.focal_origins.get(name, 'refined')}, first image {name})"
        for name, focal in quality.focal_lengths.items()
    ]
    return {
        "Photos": f"{quality.registered} of {quality.given} registered",
        "Verified pairs": f"{agreeing} of {quality.verified_pairs} agree with the model",
        "Contradicted images": _contradicted(quality)
        or f"none; {quality.trusted_pairs} pairs are trusted to tell",
        "Observations": f"median of {quality.median_observations:.0f} points per image, "
        f"{quality.median_track_length:.1f} images per point",
        "Between rays": f"median of {quality.triangulation_angle_deg:.1f} degrees",
        "Focal length over longer side": ", ".join(focal_lengths),
    }


def _contradicted(quality: ModelQuality) -> str:
    """The contradicted images, the least supported first; empty if there are none."""
    found = sorted(quality.contradictions.items(), key=lambda one: (one[1], one[0]))
    listed = ", ".join(f"{name} ({share:.0%})" for name, share in found)
    return listed and f"{listed}: share of the matches that agree, in the worst trusted pair of the image"
