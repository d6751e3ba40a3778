"""From the frames of a video to the poses of its camera."""

from dataclasses import dataclass, replace
from functools import partial
from time import perf_counter
from typing import Literal

import pycolmap

from slimsfm.arrays import Image, Points2D
from slimsfm.features import shrink_factor
from slimsfm.geometry import corner_error, resized_camera
from slimsfm.localization import Localization, Localizer, Seconds
from slimsfm.localization.cameras import QueryCamera
from slimsfm.pose import PoseEstimate
from slimsfm.tracking.background import BackgroundLocalization, BackgroundResult, Relocalizer, is_ambiguous
from slimsfm.tracking.templates import (
    GrayFrame,
    Templates,
    cut_templates,
    join_templates,
    spread_over_cells,
    to_gray_frame,
)
from slimsfm.tracking.track import Track, begin_track, follow_track, smoothed_pose

State = Literal["tracked", "localized", "lost"]

_CELL = 1 / 40  # side of a cell that matches are spread over, relative to the image's longer side
_SURE_SHARE = 0.5  # of the points expected in sight; as long as these are seen, the confidence stays
_DOUBT = 0.3  # confidence at which a track is given up
_CONTRADICTION = 0.1  # corner error, over the diagonal, at which localization contradicts the track


@dataclass(frozen=True, kw_only=True)
class TrackerOptions:
    """How an object is tracked."""

    max_points: int = 250
    """Largest number of map points to track."""

    max_image_size: int = 640
    """Longer side, in pixels, to which frames are shrunk for tracking. Localization uses whole frames."""

    renew_every: int = 20
    """Largest number of frames between localizations in the background of tracking."""

    lag: int = 5
    """Number of frames after which the result of a background localization is used. It is constant however
    fast the machine is, so that the poses depend on the frames alone."""

    begin_confidence: float = 0.8
    """Smallest confidence of a pose that begins a track. While the object is out of sight, many frames are
    searched, and a single false pose among them would begin a false track."""

    search_every: int = 8
    """Largest number of frames between searches of a whole frame while the object is out of sight. Other
    frames are searched only where it was last seen. 1 searches every whole frame, which is slow."""

    smoothing: float = 0.0
    """Number of frames over which poses of a still camera are smoothed; fast motion is not smoothed. 0: no
    smoothing."""

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
    """Result of tracking one frame."""

    localization: Localization
    """The pose and the matches that support it. All time of a tracked frame counts as matching."""

    state: State
    """Tracked from the frame before; localized without a track; or lost, where localization failed too."""

    seconds: float
    """Time from the decoded frame to the pose."""

    frame_seconds: float | None = None
    """When the frame is shown in its video; None where that is unknown."""

    @property
    def pose(self) -> PoseEstimate | None:
        """Pose of the camera; None where the object was not found.

        The confidence of a tracked pose is that of the localization its track goes back to. Where fewer than
        half of the points expected in sight are seen, it is reduced in proportion. Each background
        localization without a pose halves it, and a track of little confidence is given up.
        """
        return self.localization.pose

    @property
    def num_points(self) -> int:
        """Number of map points that support the pose."""
        return self.pose.num_inliers if self.pose else 0


class Tracker:
    """Tracks one object through the frames of a video; equal frames give equal poses.

    While the object is in sight, each frame is tracked from the one before, and now and then a frame is
    localized on another thread. When the object is lost, frames are localized at once. The intrinsics that
    the first localization estimates are kept.
    """

    def __init__(self, localizer: Localizer, options: TrackerOptions = TrackerOptions()) -> None:
        self._localizer = localizer
        self._options = options
        self._box = localizer.map.box
        self._background = BackgroundLocalization(self._box.center, options.renew_every, options.lag)
        self._relocalizer = Relocalizer(localizer, options.search_every, options.begin_confidence)
        self._track: Track | None = None
        self._confidence: float | None = None
        self._smoothed_cam_from_world: pycolmap.Rigid3d | None = None
        self._frame_index = -1
        self._estimated: pycolmap.Camera | None = None

    def track(self, image: Image, camera: pycolmap.Camera | QueryCamera | None = None) -> Tracked:
        """Find the pose of the camera in the next frame.

        Args:
            image: RGB, upright or as stored as the map says.
            camera: Intrinsics of the frame, see `Localizer.localize`.

        Raises:
            ValueError: As in `Localizer.localize`.
        """
        start = perf_counter()
        self._frame_index += 1
        believed = self._believed(image, camera)
        frame = to_gray_frame(image, believed.camera, self._options.max_image_size)
        track = self._followed(frame)
        if track:
            near = track.pose.cam_from_world
            # copy, because the caller may reuse the memory for the next frame
            localize = partial(self._localizer.localize_near, image.copy(), believed, near)
            self._background.start_if_due(self._frame_index, track, localize)
            state, localization = "tracked", self._as_localization(track, believed, perf_counter() - start)
        else:
            if self._track:
                self._relocalizer.mark_lost(self._frame_index, self._track.pose.cam_from_world)
            localization = self._unambiguous(self._relocalizer.localize(self._frame_index, image, believed))
            track = self._begun(localization, image)
            state = "localized" if track else "lost"
            if track:
                self._background.restart(self._frame_index, track)
        self._track = track
        localization = replace(localization, orientation=self._localizer.map.info.orientation)
        return Tracked(localization=self._smoothed(localization), state=state, seconds=perf_counter() - start)

    def _believed(self, image: Image, camera: pycolmap.Camera | QueryCamera | None) -> QueryCamera:
        """The intrinsics of a frame: those that were estimated for a frame of its size, else as usual."""
        known = self._estimated
        if known and (known.width, known.height) == image.shape[1::-1]:
            return QueryCamera(camera=known, source="queries")
        return self._localizer.camera_of(image, camera)

    def _followed(self, frame: GrayFrame) -> Track | None:
        """The track in the next frame, with new templates if a background result is due; None if lost."""
        track = self._track
        if track is None or track.frame.gray.shape != frame.gray.shape:
            return None
        result = self._background.result_for(self._frame_index)
        templates = self._updated_templates(track, result) if result else track.templates
        return follow_track(track, templates, frame, self._box) if templates else None

    def _updated_templates(self, track: Track, result: BackgroundResult) -> Templates | None:
        """Templates including those of a background result; None where it contradicts the track."""
        pose = result.localization.pose
        if pose is None:
            self._confidence = None if self._confidence is None else self._confidence / 2
            doubtful = self._confidence is not None and self._confidence < _DOUBT
            return None if doubtful else track.templates
        if corner_error(pose.cam_from_world, result.tracked_cam_from_world, self._box) > _CONTRADICTION:
            return track.templates if self._is_ambiguous(result.localization, pose) else None
        self._confidence = pose.confidence
        _, new = self._templates(result.localization, pose, result.frame)
        return join_templates(new, track.templates, self._options.max_points)

    def _unambiguous(self, found: Localization) -> Localization:
        """The localization, without its pose if that is only one of two."""
        if found.pose and self._is_ambiguous(found, found.pose):
            reason = "the matches agree with two poses"
            return replace(found, pose=None, reason=reason, predicted_corner_error=None)
        return found

    def _is_ambiguous(self, found: Localization, pose: PoseEstimate) -> bool:
        points2D, points3D = found.points2D[pose.inliers], found.points3D_in_world[pose.inliers]
        camera = found.camera
        factor = shrink_factor(self._localizer.extractor.options, camera.width, camera.height)
        small = resized_camera(camera, 1 / factor)
        return is_ambiguous(points2D / factor, points3D, pose.cam_from_world, small, self._box)

    def _begun(self, localization: Localization, image: Image) -> Track | None:
        """The track that begins with a localized image; None where the localization has no pose."""
        pose = localization.pose
        if pose is None:
            return None
        if pose.estimated:
            self._estimated = localization.camera
        frame = to_gray_frame(image, localization.camera, self._options.max_image_size)
        points2D, templates = self._templates(localization, pose, frame)
        self._confidence = pose.confidence
        return begin_track(templates, points2D, frame, pose)

    def _templates(
        self, localization: Localization, pose: PoseEstimate, frame: GrayFrame
    ) -> tuple[Points2D, Templates]:
        """Pixels and templates of inliers of a localization, spread over the frame."""
        points2D = localization.points2D[pose.inliers] * frame.scale
        points3D = localization.points3D_in_world[pose.inliers]
        cell_px = _CELL * max(frame.gray.shape)
        rows = spread_over_cells(points2D, points3D, self._options.max_points, cell_px)
        return points2D[rows], cut_templates(frame, points2D[rows], points3D[rows], pose.cam_from_world)

    def _as_localization(self, track: Track, camera: QueryCamera, seconds: float) -> Localization:
        seen, confidence = track.seen, self._confidence
        if confidence is not None:
            confidence *= min(1.0, len(seen.rows) / (_SURE_SHARE * seen.num_expected))
        return Localization(
            pose=replace(track.pose, confidence=confidence),
            camera=camera.camera,
            camera_source=camera.source,
            points2D=seen.points2D / track.frame.scale,
            points3D_in_world=track.templates.points3D_in_world[seen.rows],
            references=0,
            predicted_corner_error=track.pose.predicted_corner_error(self._box),
            seconds=Seconds(extract=0.0, match=seconds, pose=0.0),
        )

    def _smoothed(self, localization: Localization) -> Localization:
        """The localization to return, with its pose smoothed."""
        pose, last = localization.pose, self._smoothed_cam_from_world
        if pose and last and self._options.smoothing:
            smoothed = smoothed_pose(pose.cam_from_world, last, self._box, self._options.smoothing)
            localization = replace(localization, pose=replace(pose, cam_from_world=smoothed))
        self._smoothed_cam_from_world = localization.pose and localization.pose.cam_from_world
        return localization
