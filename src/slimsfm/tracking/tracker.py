"""From the frames of a video to the poses of its camera."""

from dataclasses import dataclass, replace
from functools import partial
from time import perf_counter
from typing import Literal

import pycolmap

from slimsfm.arrays import Image, Points2D
from slimsfm.geometry import corner_error
from slimsfm.localization import Localization, Localizer, Seconds
from slimsfm.pose import PoseEstimate
from slimsfm.tracking.ambiguity import is_ambiguous
from slimsfm.tracking.background import Renewal, Renewed
from slimsfm.tracking.gray_frame import View, view_of
from slimsfm.tracking.motion import smoothed
from slimsfm.tracking.relocalization import Recovery
from slimsfm.tracking.templates import Templates, cut_out, joined, spread
from slimsfm.tracking.track import Track, begun, follow

State = Literal["tracked", "localized", "lost"]

_CELL = 1 / 40  # side of a cell that matches are spread over, of the image's longer side
_SURE_SHARE = 0.5  # of the points that should be in sight, seen: does not lower the confidence
_DOUBT = 0.3  # confidence at which a track is given up
_CONTRADICTION = 0.1  # corner error, over the diagonal, at which tracking and localization speak of two poses


@dataclass(frozen=True, kw_only=True)
class TrackerOptions:
    """How an object is followed."""

    max_points: int = 250
    """Most points of the map that are followed."""

    max_image_size: int = 640
    """Track in frames shrunk so that their longer side has this many pixels; localize in whole ones."""

    renew_every: int = 20
    """After at most so many frames one is localized anew beside the tracking."""

    lag: int = 5
    """Frames after which what was found beside is taken over: always as many, however fast the machine is, so
    that the poses depend on the frames alone."""

    begin_confidence: float = 0.8
    """A track begins with a pose at least this sure: where nothing is in sight, many frames are searched, and
    one false pose in them is one too many."""

    search_every: int = 8
    """While the object is out of sight, a whole frame is searched at least as often as this, and the others
    only where it was seen last. 1: every frame, which is slow."""

    smoothing: float = 0.0
    """Frames over which the poses of a still camera are smoothed; fast motion stays as it is. 0: none."""

    def __post_init__(self) -> None:
        if self.max_image_size < 64:
            raise ValueError(f"max_image_size must be at least 64, got {self.max_image_size}")
        if not 0 <= self.begin_confidence <= 1:
            raise ValueError(f"begin_confidence must be between 0 and 1, got {self.begin_confidence}")
        for name in ("max_points", "renew_every", "lag", "search_every"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        if not self.smoothing >= 0:
            raise ValueError(f"smoothing must not be negative, got {self.smoothing}")


@dataclass(frozen=True, kw_only=True, eq=False)
class Tracked:
    """What became of one frame."""

    localization: Localization
    """The pose and the matches that it rests on. All time of a tracked frame counts as matching."""

    state: State
    """Tracked from the frame before; localized on its own; or lost, which not even that could help."""

    seconds: float
    """Time it took, from the decoded frame to the pose."""

    @property
    def pose(self) -> PoseEstimate | None:
        """Where the camera stood; None where the object is out of sight.

        The confidence of a tracked pose is that of the localization that its track goes back to; where fewer
        than half of the points are seen that should be in sight, it is lower in proportion. Each localization
        beside the tracking that finds nothing halves it, and where little is left the track is given up.
        """
        return self.localization.pose

    @property
    def num_points(self) -> int:
        """Points of the map that the pose rests on."""
        return self.pose.num_inliers if self.pose else 0


class Tracker:
    """Follows one object through the frames of a video; equal frames give equal poses.

    Where the object is in sight, each frame is followed from the one before, and now and then one is
    localized on another thread. Where it is lost, the frame is localized at once. The localizer must take the
    focal length as known.
    """

    def __init__(self, localizer: Localizer, options: TrackerOptions = TrackerOptions()) -> None:
        self._localizer = localizer
        self._options = options
        self._box = localizer.map.box
        self._renewal = Renewal(self._box.center, options.renew_every, options.lag)
        self._recovery = Recovery(localizer, options.search_every, options.begin_confidence)
        self._track: Track | None = None
        self._confidence: float | None = None
        self._given_cam_from_world: pycolmap.Rigid3d | None = None
        self._frame = -1

    def track(self, image: Image, camera: pycolmap.Camera | None = None) -> Tracked:
        """Find where the camera stood in the next frame.

        Args:
            image: Upright RGB.
            camera: Its intrinsics; those of the map where all reference images share a camera and the sizes
                agree up to a common scale.

        Raises:
            ValueError: No camera is given and the map's cannot stand in, or it is of another size.
        """
        start = perf_counter()
        self._frame += 1
        camera = self._localizer.camera_of(image, camera)
        view = view_of(image, camera, self._options.max_image_size)
        track = self._followed(view)
        if track:
            near = track.pose.cam_from_world
            # a copy: the caller may put the next frame into the same memory
            beside = partial(self._localizer.localize_near, image.copy(), camera, near)
            self._renewal.begin_if_wanted(self._frame, track, beside)
            state, localization = "tracked", self._as_localization(track, camera, perf_counter() - start)
        else:
            if self._track:
                self._recovery.lost(self._frame, self._track.pose.cam_from_world)
            localization = self._unambiguous(self._recovery.seek(self._frame, image, camera))
            track = self._begun(localization, view)
            state = "localized" if track else "lost"
            if track:
                self._renewal.restart(self._frame, track)
        self._track = track
        return Tracked(localization=self._smoothed(localization), state=state, seconds=perf_counter() - start)

    def _followed(self, view: View) -> Track | None:
        """The track in the next frame, its templates renewed where that is due; None where it is lost."""
        track = self._track
        if track is None or track.view.gray.shape != view.gray.shape:
            return None
        renewed = self._renewal.due(self._frame)
        templates = self._renewed(track, renewed) if renewed else track.templates
        return follow(track, templates, view, self._box) if templates else None

    def _renewed(self, track: Track, renewed: Renewed) -> Templates | None:
        """Templates that take in what was found beside; None where that speaks against the track."""
        pose = renewed.localization.pose
        if pose is None:
            self._confidence = None if self._confidence is None else self._confidence / 2
            doubtful = self._confidence is not None and self._confidence < _DOUBT
            return None if doubtful else track.templates
        if corner_error(pose.cam_from_world, renewed.tracked_cam_from_world, self._box) > _CONTRADICTION:
            return track.templates if self._is_ambiguous(renewed.localization, pose) else None
        self._confidence = pose.confidence
        _, new = self._templates(renewed.localization, pose, renewed.view)
        return joined(new, track.templates, self._options.max_points)

    def _unambiguous(self, found: Localization) -> Localization:
        """What was found, without its pose where that is but one of two."""
        if found.pose and self._is_ambiguous(found, found.pose):
            return replace(found, pose=None, predicted_corner_error=None)
        return found

    def _is_ambiguous(self, found: Localization, pose: PoseEstimate) -> bool:
        points2D, points3D = found.points2D[pose.inliers], found.points3D_in_world[pose.inliers]
        return is_ambiguous(points2D, points3D, pose.cam_from_world, found.camera, self._box)

    def _begun(self, localization: Localization, view: View) -> Track | None:
        """The track of a frame that was localized on its own; None where it was not."""
        pose = localization.pose
        if pose is None:
            return None
        points2D, templates = self._templates(localization, pose, view)
        self._confidence = pose.confidence
        return begun(templates, points2D, view, pose)

    def _templates(
        self, localization: Localization, pose: PoseEstimate, view: View
    ) -> tuple[Points2D, Templates]:
        """Inliers of a localization, spread over the image: where they are in the view, and their looks."""
        points2D = localization.points2D[pose.inliers] * view.scale
        points3D = localization.points3D_in_world[pose.inliers]
        rows = spread(points2D, points3D, self._options.max_points, _CELL * max(view.gray.shape))
        return points2D[rows], cut_out(view, points2D[rows], points3D[rows], pose.cam_from_world)

    def _as_localization(self, track: Track, camera: pycolmap.Camera, seconds: float) -> Localization:
        seen, confidence = track.seen, self._confidence
        if confidence is not None:
            confidence *= min(1.0, len(seen.rows) / (_SURE_SHARE * seen.num_expected))
        return Localization(
            pose=replace(track.pose, confidence=confidence),
            camera=camera,
            points2D=seen.points2D / track.view.scale,
            points3D_in_world=track.templates.points3D_in_world[seen.rows],
            references=0,
            predicted_corner_error=track.pose.predicted_corner_error(self._box),
            seconds=Seconds(extract=0.0, match=seconds, pose=0.0),
        )

    def _smoothed(self, localization: Localization) -> Localization:
        """What is given out of what was found."""
        pose, last = localization.pose, self._given_cam_from_world
        if pose and last and self._options.smoothing:
            given = smoothed(pose.cam_from_world, last, self._box, self._options.smoothing)
            localization = replace(localization, pose=replace(pose, cam_from_world=given))
        self._given_cam_from_world = localization.pose and localization.pose.cam_from_world
        return localization
