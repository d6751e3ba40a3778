"""What a map says of itself after photos were added."""

from collections.abc import Collection
from dataclasses import replace

from slimsfm.mapping.cameras import devices_by_camera
from slimsfm.mapping.map import Map
from slimsfm.mapping.quality import ModelQuality
from slimsfm.mapping.support import measure
from slimsfm.upkeep.new_photos import NewPhotos
from slimsfm.upkeep.origins import with_count


def described(before: Map, larger: Map, photos: NewPhotos, added: Collection[str]) -> Map:
    """The larger map with origin, notes, quality, devices and orientations of all of its images."""
    old, tags, devices = before.info, {}, {}
    for name in sorted(added):
        exif = photos.exifs[name]
        devices[name] = exif.device
        if exif.orientation != 1 and old.orientation == "upright":
            tags[name] = exif.orientation
    new_cameras = {
        camera_id: device
        for camera_id, device in devices_by_camera(larger.model, devices).items()
        if camera_id not in before.model.cameras
    }
    info = replace(
        old,
        origin=with_count(old.origin, len(added), "added"),
        notes=tuple(dict.fromkeys((*old.notes, *photos.notes))),
        exif_orientations={**old.exif_orientations, **tags},
        devices={**old.devices, **new_cameras},
        quality=old.quality and _quality(old.quality, larger, photos, added),
    )
    return replace(larger, info=info)


def _quality(old: ModelQuality, larger: Map, photos: NewPhotos, added: Collection[str]) -> ModelQuality:
    """Quality, measured again; what was said of old images stays, because they did not move.

    Poses of old images may be known, and then they are believed more than matches.
    """
    found = measure(larger.model, larger.matches, list(larger.images))
    contradictions = {name: share for name, share in found.contradictions.items() if name in added}
    contradictions |= old.contradictions
    doubtful = {*old.doubtful, *(name for name in found.doubtful if contradictions and name in added)}
    origins = {
        name: old.focal_origins.get(name) or ("EXIF" if photos.cameras[name].source == "exif" else "guessed")
        for name in found.focal_lengths
        if name in old.focal_origins or name in photos.cameras
    }
    return replace(
        found,
        given=old.given + len(added),
        contradictions=dict(sorted(contradictions.items())),
        doubtful=tuple(sorted(doubtful)),
        ambiguous=old.ambiguous,
        focal_origins=origins,
    )
