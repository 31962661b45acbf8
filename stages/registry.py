"""The stages in the order the data flows through them."""

from __future__ import annotations

from pipeline.engine.stage import Stage, StageConfig
from stages import depth, fuse, ingest, match, pair, refine, report, score, sensitivity

STAGES: dict[str, Stage] = {
    stage.name: stage
    for stage in (
        ingest.STAGE,
        pair.STAGE,
        match.STAGE,
        refine.STAGE,
        depth.STAGE,
        fuse.STAGE,
        score.STAGE,
        sensitivity.STAGE,
        report.STAGE,
    )
}

MODELS: dict[str, type[StageConfig]] = {name: stage.config for name, stage in STAGES.items()}

# What a run without a workflow leaves out: it needs a truth, or has to be asked for.
ON_REQUEST = frozenset({"score", "sensitivity"})
