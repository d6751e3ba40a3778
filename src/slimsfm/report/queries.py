"""The queries of an object that the page shows: where it fails first."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float64

from slimsfm.errors import ImageError
from slimsfm.evaluation.comparison import Comparison
from slimsfm.evaluation.results import ObjectResult, Outcomes
from slimsfm.photos import read_image
from slimsfm.report.budget import Budget
from slimsfm.report.formatting import line_name, percent_of_d
from slimsfm.report.frames import QueryFrame, frame_html


def worth_seeing(errors: Float64[np.ndarray, " n"], count: int) -> list[int]:
    """Indices of so many queries: half of them the worst, worst first, the others evenly spaced."""
    if len(errors) <= count:
        return np.argsort(-errors, kind="stable").tolist()
    worst = np.argsort(-errors, kind="stable")[: (count + 1) // 2]
    others = np.setdiff1d(np.arange(len(errors)), worst)
    spaced = others[np.linspace(0, len(others) - 1, count - len(worst)).round().astype(np.int64)]
    return [*worst.tolist(), *spaced.tolist()]


def queries_html(result: ObjectResult, line: Comparison, budget: Budget) -> str:
    """Some queries with the object's box, as a slim map localizes them."""
    before, after = (
        one.map_runs[0].outcomes for key in (line.before, line.after) if (one := result.measurement(*key))
    )
    shown = worth_seeing(after.error, budget.frames)
    frames = list(_frames(result, before, after, shown))
    if not frames:
        folder = result.queries[0].path.parent
        return f'<h3>Queries</h3>\n<p class="note">The query images are not in {folder} any more.</p>'
    figures = "\n".join(frame_html(one, result.box, budget.frame_px) for one in frames)
    return f"""<h3>Queries</h3>
<p class="note">{line_name(line.after).capitalize()}: the worst first, then some evenly spaced.
<span class="estimated">Red</span>: the box under the estimated pose.
<span class="true">Green</span>: under the true one.</p>
<div class="frames">
{figures}
</div>"""


def _frames(
    result: ObjectResult, before: Outcomes, after: Outcomes, shown: list[int]
) -> Iterator[QueryFrame]:
    for i in shown:
        query = result.queries[i]
        try:
            image = read_image(query.path)
        except ImageError:
            continue
        yield QueryFrame(
            image=image,
            camera=query.camera,
            estimated_cam_from_world=after.cam_from_world[i],
            true_cam_from_world=query.cam_from_world,
            label=query.path.name,
            verdict=_verdict(before, after, i),
        )


def _verdict(before: Outcomes, after: Outcomes, i: int) -> str:
    told = percent_of_d(after.error[i])
    if np.isfinite(after.error[i]):
        told = f"off by {told}, confidence {after.confidence[i]:.2f}"
    return f"{told} (full map: {percent_of_d(before.error[i])})"
