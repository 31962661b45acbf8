"""The one constant translation between a survey and the poses, from control points: no scale, no rotation.

Truth and poses are georeferenced apart. Shifted by the translation, the surveyed places project onto their sightings;
the same shift brings everything else of the survey to the poses.

Source: the paper, section IV, "Ground Truth".
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.engine.errors import InputError, UndeterminedError
from pipeline.geometry.arrays import Bools, Floats
from pipeline.geometry.cameras import Camera
from pipeline.geometry.pose_errors import PoseErrors
from pipeline.geometry.poses import Placement
from pipeline.scoring.sighted import Offsets, Sighted, best_shift
from pipeline.scoring.sighting_errors import FrameErrors, shift_covariance
from pipeline.sources.control_places import Mark

FEWEST_POINTS = 3
# A mark that is clicked in its own photo is off by a few pixels at most, or by what poses and survey explain.
_WRONG_PX, _WRONG_SIGMAS = 20.0, 3.0
# A point is doubted that the others would put so many times farther off than they are themselves.
_DOUBTFUL = 5.0
# Of so many points at most one may be doubted: of more it is the list that is.
_POINTS_PER_DOUBT = 3
_FAR_SIGMAS = 5.0
# A shift that is known to this share of the distances only makes errors of that share.
_LOOSE_SHARE = 0.02


@dataclass(frozen=True, slots=True)
class PointFit:
    """How far the projections of a surveyed place are from its sightings.

    Args:
        name: The point's.
        frames: (m,) frame_ids.
        before_px: (m,) as surveyed; infinite where the camera does not see it.
        after_px: (m,) shifted by the translation.
        suspect: Whether it does not fit the others, and was left out of the fit.
        fits: Another point whose place these sightings fit, where it is a suspect; "" where there is none.
    """

    name: str
    frames: tuple[str, ...]
    before_px: Floats
    after_px: Floats
    suspect: bool
    fits: str


@dataclass(frozen=True, slots=True)
class Translation:
    """What is added to the survey so that it meets the poses.

    Args:
        translation_m: (3,) ENU.
        covariance: (3, 3) m^2, by what the fit leaves over.
        points: All that are seen, those left out as well.
        told: What a careful user wants to hear before believing the figures.
    """

    translation_m: Floats
    covariance: Floats
    points: tuple[PointFit, ...]
    told: tuple[str, ...]

    def rests_on(self, marks: Sequence[Mark]) -> list[Mark]:
        """Those of the points that it was solved from that were not left out."""
        used = {fit.name for fit in self.points if not fit.suspect}
        return [mark for mark in marks if mark.name in used]

    def metrics(self, left_out: Mapping[str, str]) -> dict[str, Any]:
        """The object `control_points` of metrics.json; what was out of sight before has no pixels, and is counted.

        Args:
            left_out: Why rows of the list were, by row.
        """
        used = [fit for fit in self.points if not fit.suspect]
        before, after = (np.concatenate([getattr(fit, which) for fit in used]) for which in ("before_px", "after_px"))
        return {
            "points": len(used),
            "observations": len(after),
            "observations_out_of_sight": int(np.sum(~np.isfinite(before))),
            "rms_before_px": _rms(before),
            "rms_after_px": _rms(after),
            "translation_m": self.translation_m.tolist(),
            "sigma_m": np.sqrt(np.diag(self.covariance)).tolist(),
            "by_point": {
                fit.name: {
                    "observations": len(fit.frames),
                    "rms_before_px": _rms(fit.before_px),
                    "rms_after_px": _rms(fit.after_px),
                }
                for fit in self.points
            },
            "suspects": [
                {
                    "name": fit.name,
                    "rms_px": _rms(fit.after_px),
                    "worst_frame": _worst_frame(fit),
                    "fits": fit.fits or None,
                }
                for fit in self.points
                if fit.suspect
            ],
            "left_out": dict(left_out),
        }


def solve_translation(
    marks: Sequence[Mark],
    placements: Mapping[str, Placement],
    cameras: Mapping[str, Camera],
    errors: PoseErrors,
    sigma_m: float,
    where: str = "",
) -> Translation:
    """The translation by least squares of the reprojection residuals.

    A point that does not fit the others is left out and told.

    Args:
        marks: Points with their surveyed places and sightings; frames that are not placed are passed over.
        placements: By frame_id.
        cameras: By frame_id.
        errors: Of the poses.
        sigma_m: One sigma of the surveyed coordinates along each axis.
        where: The list, named in errors.

    Raises:
        UndeterminedError: Fewer than three points are seen.
        InputError: The points do not fit the photos, or one another.
    """
    sighted = Sighted.of(marks, placements, cameras)
    if len(sighted.points) < FEWEST_POINTS:
        raise _too_few(sighted, where)
    frame_errors = FrameErrors.of(errors, sighted.frame_ids)
    kept, doubted = _agreeing(sighted, frame_errors, sigma_m)
    shift = best_shift(kept)
    fits = _fits(sighted, shift, doubted)
    at = kept.offsets(shift)
    _check_fit(kept, at, frame_errors, sigma_m, fits, where)
    if len(doubted) > _most_doubted(len(sighted.points)):
        raise _disagree(fits, where)
    covariance = shift_covariance(kept, at, frame_errors, sigma_m)
    return Translation(shift, covariance, fits, tuple(_doubts(at, shift, covariance, frame_errors, fits)))


def _agreeing(sighted: Sighted, errors: FrameErrors, sigma_m: float) -> tuple[Sighted, set[int]]:
    """The sightings of the points that agree, and the points that do not agree with them.

    Two wrong points hide one another while either is in the fit: more than half of the points, those that fit best,
    say which of the others belong to them.
    """
    kept = sighted
    while len(kept.points) > len(sighted.points) // 2 + 1:
        kept = kept.where(kept.point != _least_fitting(kept))
    points = sighted.points
    while True:
        shift = best_shift(kept)
        # The fit takes three numbers: one and a half of the distances.
        freedom = max(len(kept.point) - 1.5, 0.5)
        scatter = np.sum(kept.offsets(shift).distance_px ** 2) / freedom
        at = sighted.offsets(shift)
        expected = _by_point(sighted, errors.expected_px(sighted, at, sigma_m) ** 2)[points]
        off, count = (_by_point(sighted, values)[points] for values in (at.distance_px**2, np.ones(len(at.seen))))
        fitting = points[off <= _DOUBTFUL**2 * (count * scatter + expected)]
        agreed = np.union1d(fitting, kept.points)
        if len(agreed) == len(kept.points):
            return kept, set(points.tolist()) - set(agreed.tolist())
        kept = sighted.where(np.isin(sighted.point, agreed))


def _least_fitting(sighted: Sighted) -> int:
    """The point without which the others fit best, by one step from the fit of all."""
    at = sighted.offsets(best_shift(sighted))
    information = _by_point(sighted, np.einsum("mki,mkj->mij", at.by_shift, at.by_shift))
    gradient = _by_point(sighted, np.einsum("mki,mk->mi", at.by_shift, at.found_px))
    squares = _by_point(sighted, np.sum(at.found_px**2, axis=1))
    unseen = _by_point(sighted, (~at.seen).astype(np.float64))
    rest, pull = information.sum(axis=0) - information, gradient.sum(axis=0) - gradient
    step = (np.linalg.pinv(rest, hermitian=True) @ pull[:, :, None])[:, :, 0]
    left = squares.sum() - squares - np.sum(pull * step, axis=1)
    # Points out of sight are worse than any that can be measured.
    points = sighted.points
    return int(points[np.lexsort((left[points], -unseen[points]))[0]])


def _by_point(sighted: Sighted, values: Floats) -> Floats:
    out = np.zeros((len(sighted.names), *values.shape[1:]))
    np.add.at(out, sighted.point, values)
    return out


def _most_doubted(points: int) -> int:
    return min(points // _POINTS_PER_DOUBT, points - FEWEST_POINTS)


def _fits(sighted: Sighted, shift: Floats, doubted: set[int]) -> tuple[PointFit, ...]:
    before, after = (sighted.offsets(by).distance_px for by in (np.zeros(3), shift))
    fits = []
    for point in sighted.points.tolist():
        rows: Bools = sighted.point == point
        frames = tuple(sighted.frame_ids[i] for i in sighted.frame[rows])
        whose = _whose(sighted.where(rows), shift) if point in doubted else ""
        fits.append(PointFit(sighted.names[point], frames, before[rows], after[rows], point in doubted, whose))
    return tuple(fits)


def _whose(alone: Sighted, shift: Floats) -> str:
    """The point whose place the sightings of another one fit."""
    own = alone.surveyed_m[alone.point]
    left = [float(np.median(alone.offsets(shift + place - own).distance_px)) for place in alone.surveyed_m]
    best = int(np.argmin(left))
    return alone.names[best] if left[best] <= _WRONG_PX and best not in alone.point else ""


def _check_fit(
    sighted: Sighted, at: Offsets, errors: FrameErrors, sigma_m: float, fits: Sequence[PointFit], where: str
) -> None:
    """Refuses points of which most are farther off than clicks, survey and poses explain."""
    expected = float(np.median(errors.expected_px(sighted, at, sigma_m)))
    allowed = max(_WRONG_PX, _WRONG_SIGMAS * expected)
    usual = float(np.median([np.median(fit.after_px) for fit in fits if not fit.suspect]))
    if usual <= allowed:
        return
    worst = sorted(fits, key=lambda fit: -float(np.median(fit.after_px)))[:FEWEST_POINTS]
    raise InputError(
        "E-CONTROL-16", "the control points do not fit the photos, however they are shifted", where=where,
        found=f"half of them are still {_said(usual)} off, most: " + "; ".join(_named(fit) for fit in worst),
        expected=f"less than {allowed:.0f} px, which clicks, survey and poses explain",
        hint=_explained(sighted, allowed) or "see that images, names and coordinates of the rows belong together, "
        "column comes before row, and the CRS and the order of x and y are right",
    )  # fmt: skip


def _explained(sighted: Sighted, allowed_px: float) -> str:
    """What would make the points fit, if one of the usual mistakes does."""
    height = np.array([camera.height for camera in sighted.cameras], np.float64)[sighted.camera]
    u, v = sighted.pixels.T
    mistakes = {
        "columns and rows exchanged: give the column first, then the row": np.column_stack([v, u]),
        "rows counted from the top: the list seems to count them from the bottom": np.column_stack([u, height - 1 - v]),
    }
    for said, pixels in mistakes.items():
        other = sighted.with_pixels(pixels)
        left = float(np.median(other.offsets(best_shift(other)).distance_px))
        if left <= allowed_px:
            return f"they fit to {left:.1f} px with {said}"
    return ""


def _disagree(fits: Sequence[PointFit], where: str) -> InputError:
    suspects = [fit for fit in fits if fit.suspect]
    return InputError(
        "E-CONTROL-17", "the control points contradict one another", where=where,
        found=f"{len(suspects)} of {len(fits)} do not fit the others: " + "; ".join(_named(fit) for fit in suspects),
        expected=f"at least {FEWEST_POINTS} points that agree, and at most one in {_POINTS_PER_DOUBT} that does not",
        hint="see the rows of these points: a wrong image, exchanged names, or a mistyped coordinate",
    )  # fmt: skip


def _too_few(sighted: Sighted, where: str) -> UndeterminedError:
    names = [sighted.names[point] for point in sighted.points]
    count = ("none", "one only", "two only")[len(names)]
    return UndeterminedError(
        "E-CONTROL-15", "too few control points to find the translation from", where=where,
        found=f"{count} of {len(sighted.names)} points seen in photos of the flight"
        + (f": {', '.join(names)}" if names else ""),
        expected=f"at least {FEWEST_POINTS} different points, each in one photo or more",
        hint=f"add {FEWEST_POINTS - len(names)} or more to the list, far from one another, or leave "
        "score.control_points out",
    )  # fmt: skip


def _doubts(at: Offsets, shift: Floats, covariance: Floats, errors: FrameErrors, fits: Sequence[PointFit]) -> list[str]:
    told = []
    for fit in fits:
        if fit.suspect:
            others = _rms(np.concatenate([other.after_px for other in fits if not other.suspect]))
            told.append(
                f"control point {_named(fit)} does not fit the others, which are {others:.1f} px off; it was left out: "
                "see its images, name and coordinates"
            )
    allowed = np.sqrt(np.median(np.diagonal(errors.whole, axis1=1, axis2=2), axis=0)[3:])
    if np.any(np.abs(shift) > _FAR_SIGMAS * np.hypot(allowed, np.sqrt(np.diag(covariance)))):
        moved = ", ".join(f"{m:+.2f} m {axis}" for m, axis in zip(shift, ("east", "north", "up"), strict=True))
        sigmas = ", ".join(f"{m:.2f}" for m in allowed)
        told.append(
            f"control points shift the truth by {moved}, more than {_FAR_SIGMAS:g} times the sigmas of the poses "
            f"({sigmas} m); see that truth, control points and flight are of one CRS and height datum"
        )
    loose, usual = (
        float(np.sqrt(np.max(np.linalg.eigvalsh(covariance)))),
        float(np.median(np.linalg.norm(at.away_m, axis=1))),
    )
    if loose > _LOOSE_SHARE * usual:
        told.append(
            f"control points tell the translation to {loose:.2f} m only along one direction, seen from {usual:.0f} m; "
            "points farther apart, or in more photos, would tell it better"
        )
    return told


def _named(fit: PointFit) -> str:
    far, worst = int(np.sum(fit.after_px > _WRONG_PX)), _said(float(np.max(fit.after_px)))
    whose = f"; its pixels fit {fit.fits}" if fit.fits else ""
    photos = f"{far} of {len(fit.frames)} photos more than {_WRONG_PX:g} px off"
    return f"{fit.name} ({photos}, {_worst_frame(fit)} most: {worst}{whose})"


def _worst_frame(fit: PointFit) -> str:
    return fit.frames[int(np.argmax(fit.after_px))]


def _said(off_px: float) -> str:
    return f"{off_px:.0f} px" if np.isfinite(off_px) else "out of sight"


def _rms(values: Floats) -> float | None:
    seen = values[np.isfinite(values)]
    return round(float(np.sqrt(np.mean(seen**2))), 3) if len(seen) else None
