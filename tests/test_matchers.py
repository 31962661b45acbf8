"""What every matcher has to keep, as a suite that each inherits: two photos of a plane, under poses with an error."""

from __future__ import annotations

import pickle
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from feature_scenes import BAND
from plane_photos import PLANE_CAMERA, PlanePhotos, plane_photos

from pipeline.engine.errors import MissingPartError
from pipeline.geometry.arrays import Bytes
from pipeline.geometry.cameras import Camera
from pipeline.geometry.poses import RelativePose, relative_pose
from pipeline.matching.features import Features, extract
from pipeline.matching.matcher import Matcher, SearchLimits, View
from pipeline.matching.matchers import MatcherSetting, weights_of
from pipeline.matching.pair import PairMatches, match_pair

LARGER = Camera("pinhole", 1000, 760, 900.0, 902.0, 498.0, 381.0)


@cache
def photos(*, unequal: bool = False) -> tuple[PlanePhotos, RelativePose]:
    """The photos, and their relative pose as it is logged: with an error."""
    rng = np.random.default_rng(20)
    of = plane_photos(rng, (PLANE_CAMERA, LARGER if unequal else PLANE_CAMERA))
    wrong = (replace(p, centre=p.centre + rng.normal(0.0, p.own.position_m)) for p in of.poses)
    return of, relative_pose(*wrong)


def views(matcher: Matcher, images: tuple[Bytes, Bytes], cameras: tuple[Camera, Camera]) -> tuple[View, View]:
    features = extract(matcher.extractor, images) if matcher.extractor else [Features.none()] * 2
    shown = [np.repeat(image[:, :, None], 3, axis=2) if matcher.colour else image for image in images]
    ref, src = (View(*parts) for parts in zip(cameras, shown, features, strict=True))
    return ref, src


def limits(setting: MatcherSetting) -> SearchLimits:
    return SearchLimits(BAND, 1.5, setting.max_image_px)


def matched(setting: MatcherSetting, *, unequal: bool = False, subpixel: bool = True) -> PairMatches:
    of, logged = photos(unequal=unequal)
    matcher = setting.build([])
    ref, src = views(matcher, of.images, of.cameras)
    return match_pair(matcher, ref, src, logged, limits(setting), up_in_ref=of.poses[0].rotation[2], subpixel=subpixel)


# A network takes its time, and several tests look at one result.
found_by = cache(matched)


class MatcherSuite:
    """The suite.

    Args:
        name: The matcher.
        fewest: Inliers it has to find on the plane.
        coarse_px: The error its own positions have there, from and to.
        bias_px: Most of it that all share: half a pixel lost between sizes would show.
        weights: Whether it needs any.
        max_image_px: Longest side it is run at.
    """

    name: ClassVar[str]
    fewest: ClassVar[int]
    coarse_px: ClassVar[tuple[float, float]]
    weights: ClassVar[bool] = True
    bias_px: ClassVar[float] = 0.25
    max_image_px: ClassVar[int] = 800

    @property
    def pixel(self) -> float:
        """A pixel of the size matched at, in those of the photo."""
        return PLANE_CAMERA.width / self.max_image_px

    @pytest.fixture
    def setting(self, request: pytest.FixtureRequest) -> MatcherSetting:
        folder = str(request.getfixturevalue("shared") / "weights") if self.weights else None
        return MatcherSetting(self.name, self.max_image_px, 2000, weights=weights_of(self.name, folder))

    def test_matches_are_many_and_right(self, setting: MatcherSetting) -> None:
        found, (of, _) = found_by(setting), photos()
        error = np.linalg.norm(of.errors(found.ref_px, found.src_px), axis=1)[found.inlier]
        assert len(error) > self.fewest
        assert np.mean(error < self.pixel) > 0.97
        assert np.median(error) < 0.1

    def test_its_own_positions_are_as_near_as_they_are_known_to_be(self, setting: MatcherSetting) -> None:
        found, (of, _) = found_by(setting, subpixel=False), photos()
        error = of.errors(found.ref_px, found.src_px)[found.inlier]
        low, high = self.coarse_px
        assert low < np.median(np.linalg.norm(error, axis=1)) < high
        np.testing.assert_allclose(np.median(error, axis=0), 0.0, atol=self.bias_px)

    def test_none_is_made_out_of_reach(self, setting: MatcherSetting) -> None:
        (of, logged), matcher = photos(), setting.build([])
        ref, src = views(matcher, of.images, of.cameras)
        made = matcher.candidates(ref, src, logged, limits(setting))
        each = np.arange(len(made.score))
        reach = limits(setting).reach(made.ref_px, ref.camera, made.src_px, src.camera, logged)
        assert reach.allows(each, each).all()
        # Under a pose that is wrong beyond its sigma next to nothing is left that could be made.
        turned = replace(logged, translation=logged.rotation @ np.cross(logged.centre, [0.0, 0.0, 1.0]))
        elsewhere = matcher.candidates(ref, src, turned, limits(setting))
        error = np.linalg.norm(of.errors(elsewhere.ref_px, elsewhere.src_px), axis=1)
        assert np.sum(error < 2.0) < 0.25 * len(made.score)

    def test_scores_and_covariances_are_such(self, setting: MatcherSetting) -> None:
        found = found_by(setting)
        assert np.all((found.score >= 0.0) & (found.score <= 1.0))
        assert np.ptp(found.score) > 0.05
        uu, uv, vv = found.covariance.T
        assert np.isfinite(found.covariance).all()
        assert np.all((uu > 0.0) & (vv > 0.0) & (uu * vv > uv**2))

    def test_no_pixel_is_used_twice(self, setting: MatcherSetting) -> None:
        shrink = limits(setting).shrink(PLANE_CAMERA)
        made, found = found_by(setting, subpixel=False), found_by(setting)
        for pixels in (made.ref_px, made.src_px):
            assert len(np.unique(np.round(pixels / shrink), axis=0)) == len(pixels)
        for pixels in (found.ref_px[found.inlier], found.src_px[found.inlier]):
            assert len(np.unique(np.round(pixels), axis=0)) == len(pixels)

    def test_the_same_twice_and_after_a_journey_to_another_process(self, setting: MatcherSetting) -> None:
        first, again = found_by(setting), matched(pickle.loads(pickle.dumps(setting)))  # noqa: S301
        for name in ("ref_px", "src_px", "score", "covariance", "inlier"):
            assert getattr(first, name).tobytes() == getattr(again, name).tobytes()

    def test_images_of_unequal_size(self, setting: MatcherSetting) -> None:
        found, (of, _) = found_by(setting, unequal=True), photos(unequal=True)
        error = np.linalg.norm(of.errors(found.ref_px, found.src_px), axis=1)[found.inlier]
        assert len(error) > 0.5 * self.fewest
        assert np.mean(error < self.pixel) > 0.95

    @pytest.mark.parametrize("black", [(True, True), (True, False), (False, True)])
    def test_a_black_image_matches_nothing(self, setting: MatcherSetting, black: tuple[bool, bool]) -> None:
        (of, logged), matcher = photos(), setting.build([])
        images = [np.zeros_like(image) if dark else image for image, dark in zip(of.images, black, strict=True)]
        ref, src = views(matcher, (images[0], images[1]), of.cameras)
        found = match_pair(matcher, ref, src, logged, limits(setting))
        assert found.inlier.sum() == 0
        assert found.ref_px.shape == found.src_px.shape

    def test_the_same_image_twice_has_no_parallax_to_speak_of(self, setting: MatcherSetting) -> None:
        """A duplicate of a photo under a pose of its own: points at infinity or none, never an error."""
        (of, logged), matcher = photos(), setting.build([])
        still = replace(logged, rotation=np.eye(3), translation=np.array([-3.0, 0.0, 0.0]))
        ref, src = views(matcher, (of.images[0], of.images[0]), of.cameras)
        found = match_pair(matcher, ref, src, still, limits(setting))
        moved = np.linalg.norm(found.src_px - found.ref_px, axis=1)[found.inlier]
        assert np.all(moved < self.pixel)


class TestSift(MatcherSuite):
    name, fewest, coarse_px, weights = "sift", 400, (0.02, 0.3), False


class TestDis(MatcherSuite):
    name, fewest, coarse_px, weights = "dis", 800, (0.005, 0.2), False


@pytest.mark.real
class TestXFeat(MatcherSuite):
    name, fewest, coarse_px = "xfeat", 300, (0.4, 1.2)


@pytest.mark.real
class TestXFeatStar(MatcherSuite):
    name, fewest, coarse_px = "xfeat-star", 300, (0.3, 1.5)


@pytest.mark.real
class TestLighterGlue(MatcherSuite):
    name, fewest, coarse_px = "xfeat-lighterglue", 300, (0.4, 1.2)


@pytest.mark.real
@pytest.mark.slow
class TestRaft(MatcherSuite):
    name, fewest, coarse_px = "raft", 800, (0.03, 0.5)
    max_image_px = 320


def test_every_matcher_of_the_configuration_has_its_suite() -> None:
    from stages.match import Config  # noqa: PLC0415

    named = {suite.name for suite in MatcherSuite.__subclasses__()}
    assert named == set(Config.model_fields["matcher"].annotation.__args__)


@pytest.mark.parametrize("name", ["xfeat", "xfeat-star", "xfeat-lighterglue", "raft"])
def test_without_weights_the_remedy_is_told(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("EPITRANSFER_WEIGHTS", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with pytest.raises(MissingPartError, match="E-WEIGHTS-01") as caught:
        weights_of(name, None)
    assert "epitransfer models fetch" in caught.value.hint
