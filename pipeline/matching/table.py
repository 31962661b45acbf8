"""Matches of a pair as rows of their table."""

from __future__ import annotations

import pyarrow as pa

from pipeline.matching.pair import PairMatches
from schemas import MATCHES


def matches_table(pair_id: str, found: PairMatches) -> pa.Table:
    """The rows of `matches` of one pair."""
    return MATCHES.from_columns(
        {
            "pair_id": [pair_id] * len(found.score),
            "ref_u": found.ref_px[:, 0],
            "ref_v": found.ref_px[:, 1],
            "src_u": found.src_px[:, 0],
            "src_v": found.src_px[:, 1],
            "score": found.score.astype("float32"),
            **{name: found.covariance[:, i].astype("float32") for i, name in enumerate(("cov_uu", "cov_uv", "cov_vv"))},
            "inlier": found.inlier,
        }
    )
