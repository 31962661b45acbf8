"""How far sightings may be from the projections of surveyed places, and how well a shift is known from what is left.

A sighting is off by a click of its own, by the error of its frame, which all points in that frame share, and by the
error of its point's survey, which all frames that see it share. With J the pixels by the shift, H = J^T J, and r what
is left of a least squares fit, r = Q e with Q = I - J H^-1 J^T; the covariance of e is taken as a I + b B B^T, B the
stated roots of frames and points. What is left says more of many clicks than of few shared errors, and these make the
shift's sigma: both scales are found from r, and weighed against the stated ones,

    E[r^T r] = a tr Q + b tr(B^T Q B),  E[|B^T r|^2] = a tr(B^T Q B) + b |B^T Q B|^2

and the shift's covariance is a H^-1 + b H^-1 J^T B B^T J H^-1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls
from scipy.sparse import coo_array, csr_array, hstack

from pipeline.geometry.arrays import Floats, Ints
from pipeline.geometry.pose_errors import PoseErrors
from pipeline.scoring.sighted import Offsets, Sighted

# A mark is clicked, by hand or by a detector, to about a pixel of the photo.
CLICK_PX = 1.0
# What is stated counts as much as so many squares that were found.
_PRIOR_FREEDOM = 3.0
_NOTHING = 1e-12


@dataclass(frozen=True, slots=True)
class FrameErrors:
    """What is known of the errors of frames, taken apart.

    Args:
        whole: (f, 6, 6) covariances of turn (rad) and shift (m), ENU.
        shared: (f, 6, 6) the part that is shared with other frames, by the mean of what is kept.
        own: (f, 6, 6) the rest.
        couples: (2, k) different frames whose covariance is kept, each couple once.
        blocks: (k, 6, 6) of the first by the second.
    """

    whole: Floats
    shared: Floats
    own: Floats
    couples: Ints
    blocks: Floats

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
        ends: Ints = row[np.stack(np.divmod(errors.couples, len(errors.index)))]
        two = (ends[0] >= 0) & (ends[1] >= 0) & (ends[0] != ends[1])
        couples, blocks = ends[:, two], errors.blocks[two]
        total, count = np.zeros_like(whole), np.zeros(len(number))
        for end in couples:
            np.add.at(total, end, 0.5 * (blocks + np.swapaxes(blocks, 1, 2)))
            np.add.at(count, end, 1.0)
        shared = total / np.maximum(count, 1.0)[:, None, None]
        root = _root(whole - shared)
        return FrameErrors(whole, shared, root @ np.swapaxes(root, 1, 2), couples, blocks)

    def of_sum(self, factors: Floats) -> Floats:
        """(d, d) covariance of the sum of the frames' errors times factors (f, d, 6).

        Where no covariance is kept between two frames, it is taken as the mean of what the two share with others.
        """
        one, other = self.couples
        kept = self.blocks - 0.5 * (self.shared[one] + self.shared[other])
        crossed = np.einsum("kdi,kij,kej->de", factors[one], kept, factors[other], optimize=True)
        total = np.einsum("fdi,fij->dj", factors, self.shared) @ factors.sum(axis=0).T
        alone = np.einsum("fdi,fij,fej->de", factors, self.whole - self.shared, factors, optimize=True)
        out: Floats = alone + crossed + crossed.T + 0.5 * (total + total.T)
        return out

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

    Source: moments of quadratic forms as in MINQUE (Rao, Journal of Multivariate Analysis 1, 1971); their degrees of
    freedom after Satterthwaite (Biometrics Bulletin 2, 1946).
    """
    roots = _roots(sighted, offsets, errors, sigma_m)
    by_shift, left = offsets.by_shift.reshape(-1, 3), offsets.found_px.ravel()
    # Not the inverse: weak geometry shall be seen in the sigmas, and not end the run.
    inverse = np.linalg.pinv(by_shift.T @ by_shift, hermitian=True)
    along = np.asarray(roots.T @ by_shift)
    folded, gram = inverse @ (along.T @ along), roots.T @ roots
    single = 2.0 * np.count_nonzero(offsets.seen) - 3.0
    mixed = float(roots.multiply(roots).sum() - np.trace(folded))
    shared = float(gram.multiply(gram).sum() - 2.0 * np.trace(inverse @ along.T @ (gram @ along)))
    shared += float(np.sum(folded * folded.T))
    a, b = _scales(single, mixed, shared, np.array([np.sum(left**2), np.sum((roots.T @ left) ** 2)]))
    out: Floats = a * inverse + b * folded @ inverse
    return out


def _scales(single: float, mixed: float, shared: float, squares: Floats) -> Floats:
    """(2,) variances of a click, px^2, and of the stated roots, 1, by the traces of the two forms and their squares.

    What few squares say is as uncertain as they are few: they are weighed against what is stated, as the mean of an
    inverse chi-squared distribution that began with the stated ones.
    """
    stated = np.array([CLICK_PX**2, 1.0])
    expected = np.array([[single, mixed], [mixed, shared]])
    weight = 1.0 / np.sqrt(np.maximum([single, shared], _NOTHING))
    found = nnls(expected * weight[:, None], squares * weight)[0]
    freedom = np.array([single, mixed**2 / max(shared, _NOTHING)])
    out: Floats = (freedom * found + _PRIOR_FREEDOM * stated) / (freedom + _PRIOR_FREEDOM - 2.0)
    return out


def stated_covariance(sighted: Sighted, offsets: Offsets, weight: Floats, errors: FrameErrors) -> Floats:
    """(3, 3) m^2 of weighted sums of offsets, by the sigmas that clicks and poses are stated with.

    Args:
        sighted: The sightings.
        offsets: At the places where they are taken to be.
        weight: (3, m, 2) m / px.
        errors: Of the frames.
    """
    factors = np.zeros((len(errors.whole), 3, 6))
    np.add.at(factors, sighted.frame, np.einsum("dmk,mki->mdi", weight, offsets.by_pose))
    flat = weight.reshape(3, -1)
    out: Floats = errors.of_sum(factors) + CLICK_PX**2 * flat @ flat.T
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
