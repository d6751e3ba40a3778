from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from scenes import camera, exact_map, poses
from slimsfm.features import EXTRACTORS, Features
from slimsfm.geometry import project
from slimsfm.localization import LocalizationOptions, Localizer
from slimsfm.localization.calibration import CALIBRATED, EVIDENCE_WEIGHTS, evidence_weights
from slimsfm.localization.cameras import QueryCamera
from slimsfm.localization.evidence import Evidence
from slimsfm.localization.point_descriptors import describe_appearances, describe_points, viewing_directions
from slimsfm.localization.round_result import RoundResult, suffices
from slimsfm.localization.strategies import choose_landmarks
from slimsfm.localization.strategy import PointMatches, Query
from slimsfm.mapping.map import GlobalDescriptors, observed
from slimsfm.mapping.support import measure

GOOD = Evidence(
    inliers=80,
    distinct=60,
    matched=100,
    predicted_error=0.004,
    rival=0,
    found=0.6,
    uncalibrated_error=0.03,
    misfit=0.1,
    cells=25,
)
WORSE = {
    "inliers": [70, 40, 15],
    "distinct": [40, 10, 0],
    "matched": [120, 300, 2000],
    "predicted_error": [0.01, 0.05, 2.0],
    "rival": [10, 40, 80],
    "found": [0.4, 0.1, -0.1],
    "uncalibrated_error": [0.05, 0.2, 3.0],
    "misfit": [0.3, 0.9, 20.0],
    "cells": [20, 5, 1],
    "facing": [0.9, 0.4, 0.0],
}


@pytest.mark.parametrize("name", WORSE)
def test_confidence_never_rises_as_evidence_gets_worse(name):
    values = [replace(GOOD, **{name: value}).confidence for value in WORSE[name]]
    assert [GOOD.confidence, *values] == sorted([GOOD.confidence, *values], reverse=True)
    assert all(0 < value < 1 for value in values)


@pytest.mark.parametrize("extractor", EVIDENCE_WEIGHTS)
def test_there_is_a_weight_per_term_and_none_is_negative(extractor):
    assert EVIDENCE_WEIGHTS[extractor].shape == GOOD.terms.shape
    assert np.all(EVIDENCE_WEIGHTS[extractor][1:] >= 0)


def test_every_extractor_with_its_own_weights_is_calibrated_and_exists():
    assert EVIDENCE_WEIGHTS.keys() <= CALIBRATED <= EXTRACTORS.keys()


def test_an_extractor_without_its_own_weights_uses_those_of_sift():
    for extractor in {*EXTRACTORS, "of a plug-in"} - EVIDENCE_WEIGHTS.keys():
        assert evidence_weights(extractor) is EVIDENCE_WEIGHTS["sift"]
        assert replace(GOOD, extractor=extractor).confidence == GOOD.confidence


def test_given_intrinsics_need_no_proof_for_a_fair_confidence_unless_matches_contradict_them():
    given = replace(GOOD, calibrated=True)
    assert given.confidence == GOOD.confidence > 0.9
    weak = {"distinct": 12, "inliers": 20, "matched": 60, "found": 0.3, "uncalibrated_error": 0.5}
    unproven = [replace(one, **weak).confidence for one in (given, GOOD)]
    assert 0.5 < unproven[0] <= 0.7
    assert unproven[0] > unproven[1] + 0.05
    contradicted = [replace(one, **weak, misfit=1.0).confidence for one in (given, GOOD)]
    assert contradicted[0] == contradicted[1]


@pytest.mark.parametrize("source", ["given", "map", "exif"])
def test_only_intrinsics_that_come_with_the_query_count_as_given(exact, source):
    query = QueryCamera(camera=camera(), source=source)
    (*_, last) = Localizer(exact, LocalizationOptions(strategy="exhaustive")).rounds(
        exact.features[next(iter(exact.images))], query
    )
    assert last.evidence is not None
    assert last.evidence.calibrated == (source == "given")


def found_with(evidence_of, query, lens, strategy="exhaustive"):
    options = LocalizationOptions(strategy=strategy, min_confidence=0.0)
    (*_, last) = Localizer(evidence_of, options).rounds(query, lens)
    return last


def test_an_exact_view_has_full_evidence(exact):
    last = found_with(exact, exact.features["001.png"], camera())
    evidence = last.evidence
    assert evidence.inliers == evidence.matched == len(exact.observations["001.png"].rows)
    assert evidence.rival == 0
    assert evidence.found > 0.9
    assert last.pose.confidence == evidence.confidence > 0.9


def test_a_pose_that_sees_the_surface_from_behind_is_not_believed():
    one_sided = exact_map(num_images=30, num_points=300, reach_deg=60.0)
    points, pose = one_sided.points3D_in_world, poses(30)[3]
    towards = pose.inverse().translation - points
    behind = np.einsum("nd,nd->n", viewing_directions(one_sided), towards) < 0
    descriptors = describe_appearances(one_sided).descriptors
    for rows, is_behind in ((np.flatnonzero(behind), True), (np.flatnonzero(~behind), False)):
        query = Features(
            keypoints=project(points[rows], pose, camera()).astype(np.float32),
            descriptors=descriptors[rows],
            scores=np.ones(len(rows), np.float32),
            image_size=(640, 480),
        )
        last = found_with(one_sided, query, camera())
        assert last.evidence.inliers > 50
        assert last.evidence.is_behind == is_behind
        assert (last.pose.confidence < 0.05) == is_behind


def query_of_nothing():
    features = Features(
        keypoints=np.zeros((0, 2), np.float32),
        descriptors=np.zeros((0, 128), np.float32),
        scores=np.zeros(0, np.float32),
        image_size=(640, 480),
    )
    return Query(
        keypoints=np.zeros((0, 2)), descriptors=features.descriptors, features=features, camera=camera()
    )


def test_a_search_does_not_stop_with_accurate_inliers_in_one_corner():
    def round_with(evidence):
        nothing = PointMatches.none()
        return RoundResult(
            query=query_of_nothing(),
            matches=nothing,
            pose=None,
            camera=camera(),
            evidence=evidence,
            match_seconds=0.0,
            pose_seconds=0.0,
        )

    sure = replace(GOOD, inliers=400, distinct=390, matched=410, predicted_error=0.001)
    assert sure.confidence > 0.95
    corner = replace(sure, cells=4, inliers=400)
    assert suffices([round_with(sure)])
    assert not suffices([round_with(corner)])
    assert not suffices([round_with(None)])
    assert not suffices([round_with(replace(sure, predicted_error=0.02))])


def test_next_to_contradicted_images_the_confidence_is_lower_and_elsewhere_it_is_not(exact):
    quality = measure(exact.model, {}, exact.images)
    doubted = replace(exact, info=replace(exact.info, quality=replace(quality, doubtful=("001.png",))))
    names = list(exact.images)
    far = names[len(names) // 2]
    for name in ("001.png", far):
        query = exact.features[name]
        before, after = (found_with(map_, query, camera()).pose.confidence for map_ in (exact, doubted))
        assert after == pytest.approx(0.6 * before if name == "001.png" else before)


def seen_from(map_, cam_from_world, part=slice(None)):
    """Keypoints of a part of the points of an exact map, as a camera there sees them."""
    name, seen = next(iter(map_.observations.items()))
    descriptors = np.empty((len(map_.point3D_ids), 32), np.float32)
    descriptors[seen.points] = map_.features[name].descriptors[seen.rows]
    return project(map_.points3D_in_world[part], cam_from_world, camera()), descriptors[part]


def features(parts):
    keypoints = np.concatenate([one[0] for one in parts]).astype(np.float32)
    return Features(
        keypoints=keypoints,
        descriptors=np.concatenate([one[1] for one in parts]),
        scores=np.ones(len(keypoints), np.float32),
        image_size=(640, 480),
    )


def test_a_second_pose_that_explains_the_rest_is_a_rival(exact):
    here, there = poses(11)[3], poses(7)[5]
    query = features([seen_from(exact, here, slice(0, 70)), seen_from(exact, there, slice(70, None))])
    evidence = found_with(exact, query, camera()).evidence
    assert (evidence.inliers, evidence.rival) == (70, 50)
    alone = found_with(exact, features([seen_from(exact, here, slice(0, 70))]), camera()).evidence
    assert (alone.inliers, alone.rival) == (70, 0)
    assert evidence.confidence < alone.confidence


def test_missing_visible_points_lower_the_share_found(exact):
    few = features([seen_from(exact, poses(11)[3], slice(0, 30))])
    assert found_with(exact, few, camera()).evidence.found == pytest.approx(30 / 120, abs=0.05)


def test_points_with_a_look_alike_far_away_are_not_distinct():
    plain = exact_map(num_points=60)
    assert describe_points(plain).distinct.all()
    doubled = {}
    for name, one in plain.features.items():
        seen, descriptors = plain.observations[name], one.descriptors.copy()
        by_point = dict(zip(seen.points.tolist(), seen.rows.tolist(), strict=True))
        for point in range(10):
            descriptors[by_point[point + 10]] = descriptors[by_point[point]]
        doubled[name] = replace(one, descriptors=descriptors)
    one_word = GlobalDescriptors(
        vocabulary=np.ones((1, 32), np.float32), descriptors=np.ones((len(plain.images), 32), np.float32)
    )
    described = describe_points(replace(plain, features=doubled, global_descriptors=one_word))
    apart = np.linalg.norm(plain.points3D_in_world[:10] - plain.points3D_in_world[10:20], axis=1)
    far = apart > 0.1 * plain.box.diagonal
    assert far.sum() > 5
    assert np.array_equal(described.distinct, ~np.concatenate([far, far, np.zeros(40, bool)]))


def test_landmarks_are_seen_by_every_image():
    map_ = exact_map(num_images=12, num_points=900, reach_deg=60.0)
    landmarks = choose_landmarks(map_)
    assert np.all(np.diff(landmarks) > 0)
    assert len(landmarks) < len(map_.point3D_ids) / 2
    counts = observed(map_)[:, landmarks].sum(axis=1)
    assert counts.min() >= 60


def test_an_unsure_pose_is_discarded(exact):
    query, lens = features([seen_from(exact, poses(11)[3])]), camera()
    sure = Localizer(exact).localize_features(query, lens)
    bar = LocalizationOptions(min_confidence=1.0)
    unsure = Localizer(exact, bar).localize_features(query, lens)
    assert sure.pose is not None
    assert sure.predicted_corner_error is not None
    assert unsure.pose is None
    assert unsure.predicted_corner_error is None
    assert unsure.num_matches == sure.num_matches
    with pytest.raises(ValueError, match=r"min_confidence must be between 0 and 1, got 2\.0"):
        LocalizationOptions(min_confidence=2.0)


def test_an_unknown_focal_length_is_found(exact):
    lens = camera_of(560.0)
    guess = camera_of(700.0)
    pixels = project(exact.points3D_in_world, poses(11)[3], lens)
    query = features([(pixels, seen_from(exact, poses(11)[3])[1])])
    for focal in ("approximate", "unknown"):
        options = LocalizationOptions(focal=focal)
        found = Localizer(exact, options).localize_features(query, guess)
        assert found.pose is not None
        assert found.camera.mean_focal_length() == pytest.approx(560, rel=1e-3)


def camera_of(focal_px):
    return pycolmap.Camera(model="SIMPLE_PINHOLE", width=640, height=480, params=[focal_px, 320.0, 240.0])
