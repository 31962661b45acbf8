"""Observations of one tile as arrays, and as the rows they are spilled in."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np
import pyarrow as pa

from pipeline.geometry.arrays import AnyArray, Bytes, Floats, Ints

_UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


@dataclass(frozen=True, slots=True)
class Observed:
    """Observations: each one a pixel of ref that one pair gave a depth.

    Args:
        xyz: (n, 3) in the dataset's CRS.
        jacobian: (n, 3, 12) of xyz by the errors of the two frames: turn and shift of ref, then of src.
        independent: (n, 3, 3) m^2, covariance of the error that no other observation has.
        pair: (n,) number of the pair.
        frames: (n, 2) numbers of the ref and the src frame.
        ref_px: (n, 2) pixels of ref as given.
        src_px: (n, 2) pixels of src as given.
        sigma_m: (n,) the depth's.
        depth_m: (n,).
        sight: (n, 3) what a metre of depth moves xyz by.
        footprint_m: (n,) what a pixel of ref is wide at the point.
        parallax_deg: (n,).
        rgb: (n, 3).
    """

    xyz: Floats
    jacobian: Floats
    independent: Floats
    pair: Ints
    frames: Ints
    ref_px: Floats
    src_px: Floats
    sigma_m: Floats
    depth_m: Floats
    sight: Floats
    footprint_m: Floats
    parallax_deg: Floats
    rgb: Bytes

    def __len__(self) -> int:
        return len(self.xyz)

    def take(self, rows: AnyArray) -> Observed:
        """Some of the observations, by index or mask."""
        return Observed(*(getattr(self, field.name)[rows] for field in fields(self)))

    @classmethod
    def joined(cls, parts: Sequence[Observed]) -> Observed:
        """Several, one after the other; at least one."""
        return cls(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(cls)))

    def table(self) -> pa.Table:
        """As Arrow rows; the Jacobian in single precision, 1e-7 of the error that it carries."""
        columns: dict[str, AnyArray] = {
            **{field.name: getattr(self, field.name) for field in fields(self)},
            "jacobian": self.jacobian.reshape(-1, 36).astype(np.float32),
            "independent": np.stack([self.independent[:, i, j] for i, j in _UPPER], axis=1),
        }
        return pa.table({name: _column(values) for name, values in columns.items()})

    @classmethod
    def of(cls, table: pa.Table) -> Observed:
        """From Arrow rows as `table` makes them."""
        columns: Mapping[str, AnyArray] = {field.name: _matrix(table, field.name) for field in fields(cls)}
        independent = np.empty((table.num_rows, 3, 3))
        for k, (i, j) in enumerate(_UPPER):
            independent[:, i, j] = independent[:, j, i] = columns["independent"][:, k]
        jacobian = columns["jacobian"].astype(np.float64).reshape(-1, 3, 12)
        return cls(**{**columns, "jacobian": jacobian, "independent": independent})


def _column(values: AnyArray) -> pa.Array:
    flat = pa.array(np.ascontiguousarray(values).reshape(-1))
    return flat if values.ndim == 1 else pa.FixedSizeListArray.from_arrays(flat, values.shape[1])


def _matrix(table: pa.Table, name: str) -> AnyArray:
    stored = table.column(name).combine_chunks()
    if not pa.types.is_fixed_size_list(stored.type):
        plain: AnyArray = stored.to_numpy(zero_copy_only=False)
        return plain
    values: AnyArray = stored.flatten().to_numpy(zero_copy_only=False)
    return values.reshape(table.num_rows, -1)
