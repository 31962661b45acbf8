"""The rows of `depths` brought beside each other: one line per match, one column per method."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from pipeline.engine.errors import InputError
from pipeline.geometry.arrays import AnyArray, Bools, Floats
from pipeline.scoring.metrics import usable


@dataclass(frozen=True, slots=True)
class AlignedDepths:
    """Depths of the same matches by several methods.

    Args:
        methods: (m,) names, in order.
        pair_id: (n,) the pair of each match.
        frame_id: (n,) its ref frame.
        pixels: (n, 2) u, v in the ref image as given.
        parallax_deg: (n,) angle between the two rays of the match; the methods of a match have the same.
        depth_m: (n, m) depths, m; NaN where a method has none.
        sigma_m: (n, m) predicted sigmas, m; NaN where a method has none.
        kept: (n, m) which a method publishes.
    """

    methods: tuple[str, ...]
    pair_id: AnyArray
    frame_id: AnyArray
    pixels: Floats
    parallax_deg: Floats
    depth_m: Floats
    sigma_m: Floats
    kept: Bools

    @staticmethod
    def none(methods: tuple[str, ...]) -> AlignedDepths:
        """No line."""
        nobody, values = np.zeros(0, object), np.zeros((0, len(methods)))
        return AlignedDepths(
            methods, nobody, nobody, np.zeros((0, 2)), np.zeros(0), values, values, np.zeros(values.shape, np.bool_)
        )

    @staticmethod
    def joined(parts: Sequence[AlignedDepths]) -> AlignedDepths:
        """The lines of several parts with the same methods, one after the other; at least one part."""
        names = [field.name for field in fields(AlignedDepths) if field.name != "methods"]
        columns = (np.concatenate([getattr(part, name) for part in parts]) for name in names)
        return AlignedDepths(parts[0].methods, *columns)

    def with_methods(self, names: tuple[str, ...], depth_m: Floats) -> AlignedDepths:
        """The same lines with further methods, which tell no sigma and keep every depth they have.

        Args:
            names: Of the methods.
            depth_m: (n, len(names)) m; NaN where a method has none.
        """
        return replace(
            self,
            methods=(*self.methods, *names),
            depth_m=np.concatenate([self.depth_m, depth_m], axis=1),
            sigma_m=np.concatenate([self.sigma_m, np.full(depth_m.shape, np.nan)], axis=1),
            kept=np.concatenate([self.kept, usable(depth_m, np.ones(depth_m.shape, np.bool_))], axis=1),
        )

    def where(self, rows: AnyArray) -> AlignedDepths:
        """The lines of some rows."""
        return AlignedDepths(
            self.methods, self.pair_id[rows], self.frame_id[rows], self.pixels[rows], self.parallax_deg[rows],
            self.depth_m[rows], self.sigma_m[rows], self.kept[rows],
        )  # fmt: skip


def align(depths: pa.Table, methods: tuple[str, ...]) -> AlignedDepths:
    """Brings the rows of the same match together: the k-th row of a method in a pair is the pair's k-th match.

    Args:
        depths: Rows of `depths`, each pair whole.
        methods: Every method of the run.

    Returns:
        One line per match; a method that has no rows for a pair keeps nothing of it.

    Raises:
        InputError: Two methods of a pair do not have the same pixels in the same order.
    """
    pair, pair_names = _codes(depths["pair_id"])
    method, method_names = _codes(depths["method"])
    column = np.array([methods.index(name) for name in method_names], np.int64)[method]
    # Stable, so that rows stay in the order of the matches.
    order = np.lexsort((column, pair))
    pair, column = pair[order], column[order]
    run_starts = np.flatnonzero(np.r_[True, (np.diff(pair) != 0) | (np.diff(column) != 0)]) if len(pair) else pair
    run_lengths = np.diff(np.r_[run_starts, len(pair)])
    place = np.arange(len(pair)) - np.repeat(run_starts, run_lengths)
    # Lines of a pair are as many as its longest method has; the check below refuses when another is shorter.
    longest = np.zeros(len(pair_names), np.int64)
    np.maximum.at(longest, pair[run_starts], run_lengths)
    base = np.cumsum(longest) - longest
    line = base[pair] + place
    count = int(longest.sum())
    if np.any(run_lengths != longest[pair[run_starts]]):
        raise _misaligned(pair_names[int(pair[run_starts][run_lengths != longest[pair[run_starts]]][0])])
    pixels = np.full((count, 2), np.nan)
    uv = np.column_stack([_floats(depths, "u"), _floats(depths, "v")])[order]
    pixels[line] = uv
    if np.any(differs := np.any(pixels[line] != uv, axis=1)):
        raise _misaligned(pair_names[int(pair[differs][0])])
    parallax = np.full(count, np.nan)
    parallax[line] = _floats(depths, "parallax_deg")[order]
    out_depth, out_sigma = (np.full((count, len(methods)), np.nan) for _ in range(2))
    out_kept = np.zeros((count, len(methods)), np.bool_)
    depth, sigma = _floats(depths, "depth_m")[order], _floats(depths, "sigma_depth_m")[order]
    out_depth[line, column], out_sigma[line, column] = depth, sigma
    out_kept[line, column] = usable(depth, np.asarray(depths["kept"].to_numpy(), np.bool_)[order])
    names, frames = np.empty(count, object), np.empty(count, object)
    names[line] = np.asarray(pair_names, object)[pair]
    frames[line] = depths["frame_id"].to_numpy()[order]
    return AlignedDepths(methods, names, frames, pixels, parallax, out_depth, out_sigma, out_kept)


def _codes(column: pa.ChunkedArray) -> tuple[AnyArray, list[str]]:
    encoded = pc.dictionary_encode(column.combine_chunks())
    return np.asarray(encoded.indices.to_numpy(), np.int64), encoded.dictionary.to_pylist()


def _floats(table: pa.Table, name: str) -> Floats:
    return np.asarray(table[name].to_numpy(), np.float64)


def _misaligned(pair_id: str) -> InputError:
    return InputError(
        "E-SCORE-01", "the methods of a pair do not have the same pixels in the same order", where=f"depths, {pair_id}",
        expected="one row per match and method, in the order of the matches", hint="rerun the stage depth",
    )  # fmt: skip
