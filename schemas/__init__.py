"""The tables of a run folder: columns with type, unit, frame and meaning. Imports pyarrow and nothing of ours."""

from schemas._columns import Column, SchemaError, TableSchema
from schemas.cameras import CAMERAS, REFINED_CAMERAS
from schemas.clocks import CLOCKS
from schemas.depths import DEPTHS
from schemas.frames import FRAMES
from schemas.matches import MATCHES
from schemas.pairs import PAIRS
from schemas.points import POINTS
from schemas.pose_covariances import POSE_COVARIANCES
from schemas.poses import POSES
from schemas.relative_poses import RELATIVE_POSES
from schemas.scores import SCORES
from schemas.sensitivity import CURVES
from schemas.tracks import TRACKS

TABLES: dict[str, TableSchema] = {
    schema.name: schema
    for schema in (
        CAMERAS,
        FRAMES,
        TRACKS,
        CLOCKS,
        PAIRS,
        MATCHES,
        RELATIVE_POSES,
        POSES,
        POSE_COVARIANCES,
        REFINED_CAMERAS,
        DEPTHS,
        POINTS,
        SCORES,
        CURVES,
    )
}

__all__ = [
    "CAMERAS",
    "CLOCKS",
    "CURVES",
    "DEPTHS",
    "FRAMES",
    "MATCHES",
    "PAIRS",
    "POINTS",
    "POSES",
    "POSE_COVARIANCES",
    "REFINED_CAMERAS",
    "RELATIVE_POSES",
    "SCORES",
    "TABLES",
    "TRACKS",
    "Column",
    "SchemaError",
    "TableSchema",
]
