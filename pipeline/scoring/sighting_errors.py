"""How far sightings may be from the projections of surveyed places, and how well a shift is known from what is left.

A sighting is off by a click of its own, by the error of its frame, which all points in that frame share, and by the
error of its point's survey, which all frames that see it share. With J the pixels by the shift, S the covariance of all
of them and Q = I - J H^-1 J^T, H = J^T J, what is left of a least squares fit has the expected square tr(Q S). The
shift's covariance is H^-1 J^T S J H^-1, S scaled so that this is the square that was found: the model tells how errors
hang together, and the scatter how large they are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array, csr_array, hstack

from pipeline.geometry.arrays import Floats, Ints
from pipeline.geometry.pose_errors import PoseErrors
from pipeline.scoring.sighted import Offsets, Sighted

# A mark is clicked, by hand or by a detector, to about a pixel of the photo.
CLICK_PX = 1.0
# A scale that rests on fewer squares than these says little.
_LEAST_FREEDOM = 3.0


@dataclass(frozen=True, slots=True)
class FrameErrors:
    """What is known of the errors of frames, taken apart.

    Args:
        errors: Of all frames.
        number: (f,) in them, of the frames that have sightings.
        whole: (f, 6, 6) covariances of turn (rad) and shift (m), ENU.
        shared: (f, 6, 6) the part that is shared with other frames, by the mean of what is kept.
        own: (f, 6, 6) the rest.
    """

    errors: PoseErrors
    number: Ints
    whole: Floats
    shared: Floats
    own: Floats

    @staticmethod
    def of(errors: PoseErrors, frame_ids: tuple[str, ...]) -> FrameErrors:
        """Of the frames that have sightings.

        Args:
            errors: Of all frames.
            frame_ids: Which of them.
        """
        number = np.array([errors.index[name] for name in frame_ids], np.int64)
        whole = errors.of_numbers(number, number)[0]
        row = np.full(len(errors.index), -1)
        row[number] = np.arange(len(number))
        ends = row[np.stack(np.divmod(errors.couples, len(errors.index)))]
        two = (ends[0] >= 0) & (ends[1] >= 0) & (ends[0] != ends[1])
        both = 0.5 * (errors.blocks[two] + np.swapaxes(errors.blocks[two], 1, 2))
        total, count = np.zeros_like(whole), np.zeros(len(number))
        for end in ends[:, two]:
            np.add.at(total, end, both)
            np.add.at(count, end, 1.0)
        shared = total / np.maximum(count, 1.0)[:, None, None]
        root = _root(whole - shared)
        return FrameErrors(errors, number, whole, shared, root @ np.swapaxes(root, 1, 2))

    def between(self, frame: Ints) -> Floats:
        """(m, m, 6, 6) covariances between frames (m,), by what they share where none is kept."""
        found, known = self.errors.of_numbers(*np.meshgrid(self.number[frame], self.number[frame], indexing="ij"))
        shared = self.shared[frame]
        return np.where(known[:, :, None, None], found, 0.5 * (shared[:, None] + shared[None]))

    def expected_px(self, sighted: Sighted, offsets: Offsets, sigma_m: float) -> Floats:
        """(m,) one sigma of the distances that a shift cannot remove: a shift that frames share it does.

        Args:
            sighted: The sightings.
            offsets: At the shift.
            sigma_m: Of the survey along each axis.
        """
        kept = self.own.copy()
        kept[:, :3, :3] = self.whole[:, :3, :3]
        by_pose = np.einsum("mki,mij,mkj->m", offsets.by_pose, kept[sighted.frame], offsets.by_pose)
        by_survey = sigma_m**2 * np.sum(offsets.by_shift**2, axis=(1, 2))
        out: Floats = np.sqrt(2.0 * CLICK_PX**2 + by_pose + by_survey)
        return out


def shift_covariance(sighted: Sighted, offsets: Offsets, errors: FrameErrors, sigma_m: float) -> Floats:
    """(3, 3) m^2 of a least squares shift, by what is left of the offsets.

    Args:
        sighted: The sightings; more of them in sight than the shift needs.
        offsets: At the shift.
        errors: Of the frames.
        sigma_m: Of the survey along each axis.

    Source: the scale's distribution by the first two moments of the sum of squares (Satterthwaite, Biometrics Bulletin
    2, 1946); its share nu / (nu - 2) is the variance of Student's distribution.
    """
    roots = _roots(sighted, offsets, errors, sigma_m)
    by_shift = offsets.by_shift.reshape(-1, 3)
    # Not the inverse: weak geometry shall be seen in the sigmas, and not end the run.
    inverse = np.linalg.pinv(by_shift.T @ by_shift, hermitian=True)
    shared = np.asarray(roots.T @ by_shift)
    folded = shared.T @ shared
    click = CLICK_PX**2
    by_click = click * (2.0 * np.count_nonzero(offsets.seen) - 3.0)
    by_roots = float(roots.multiply(roots).sum()) - float(np.trace(inverse @ folded))
    gram = roots.T @ roots
    crossed = float(gram.multiply(gram).sum()) - 2.0 * float(np.trace(inverse @ shared.T @ (gram @ shared)))
    crossed += float(np.sum((inverse @ folded) * (inverse @ folded).T))
    expected = by_click + by_roots
    freedom = max(expected**2 / (click * by_click + 2.0 * click * by_roots + crossed), _LEAST_FREEDOM)
    scale = float(np.sum(offsets.found_px**2)) / expected * freedom / (freedom - 2.0)
    out: Floats = scale * (click * inverse + inverse @ folded @ inverse)
    return out


def place_covariance(sighted: Sighted, offsets: Offsets, errors: FrameErrors, *, alone: bool) -> Floats:
    """(3, 3) m^2 of the place where the rays of one point meet, by the sigmas of clicks and poses.

    Args:
        sighted: The sightings of the point.
        offsets: At the place where its rays meet.
        errors: Of the frames.
        alone: Whether only what frames do not share counts: the rest moves all points alike.
    """
    frames = sighted.frame
    if alone:
        same = frames[:, None] == frames[None]
        between = np.where(same[:, :, None, None], errors.own[frames][:, None], 0.0)
    else:
        between = errors.between(frames)
    of_pixels = np.einsum("mki,mnij,nlj->mknl", offsets.by_pose, between, offsets.by_pose)
    flat = of_pixels.reshape(2 * len(frames), -1) + CLICK_PX**2 * np.eye(2 * len(frames))
    place = np.linalg.pinv(offsets.by_shift.reshape(-1, 3))
    out: Floats = place @ flat @ place.T
    return out


def _roots(sighted: Sighted, offsets: Offsets, errors: FrameErrors, sigma_m: float) -> csr_array:
    """(2m, 6f + 3p) whose square is the covariance of pixels by frames and by points."""
    by_frame = offsets.by_pose @ _root(errors.own)[sighted.frame]
    by_point = offsets.by_shift * sigma_m
    of_frames = _spread(by_frame, sighted.frame, len(errors.own))
    return csr_array(hstack([of_frames, _spread(by_point, sighted.point, len(sighted.names))]))


def _spread(blocks: Floats, group: Ints, n: int) -> coo_array:
    """(2m, k n) with the blocks (m, 2, k) in the columns of their groups."""
    m, _, k = blocks.shape
    rows = np.broadcast_to(np.arange(2 * m).reshape(m, 2, 1), blocks.shape)
    columns = np.broadcast_to((group * k)[:, None, None] + np.arange(k), blocks.shape)
    return coo_array((blocks.ravel(), (rows.ravel(), columns.ravel())), shape=(2 * m, k * n))


def _root(covariances: Floats) -> Floats:
    """(n, 6, 6) roots; what is less than nothing is nothing."""
    value, vector = np.linalg.eigh(covariances)
    out: Floats = vector * np.sqrt(np.maximum(value, 0.0))[:, None, :]
    return out
