"""What a finished run holds, read when a part of the report asks for it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import pyarrow as pa

from pipeline.engine.tables import read_table
from pipeline.flight import image_locations
from pipeline.geodesy.local_world import EARTH, LOCAL_WORLD


@dataclass(frozen=True)
class RunData:
    """A run folder as the report reads it.

    Args:
        paths: Where each table (a file) and dataset (a folder) lies, by name; what the run lacks is left out.
        records: The manifest's record of each finished stage.
    """

    paths: Mapping[str, Path]
    records: Mapping[str, Mapping[str, Any]]

    @cached_property
    def frames(self) -> pa.Table:
        """The images with their logged poses."""
        return self._table("frames")

    @cached_property
    def poses(self) -> pa.Table:
        """The refined poses."""
        return self._table("poses")

    @cached_property
    def cameras(self) -> pa.Table:
        """The cameras that depths are made with."""
        return self._table("refined_cameras")

    @cached_property
    def pairs(self) -> pa.Table:
        """The candidate pairs."""
        return self._table("pairs")

    @cached_property
    def relative_poses(self) -> pa.Table:
        """The relative poses of the pairs."""
        return self._table("relative_poses")

    @property
    def matches(self) -> Path:
        """The folder of `matches`, to be read in pieces."""
        return self.paths["matches"]

    @property
    def depths(self) -> Path:
        """The folder of `depths`, to be read in pieces."""
        return self.paths["depths"]

    @property
    def points(self) -> Path:
        """The folder of `points`, one file per tile."""
        return self.paths["points"]

    @property
    def scores(self) -> Path | None:
        """The folder with `metrics.json` and `pixels.parquet`, if the run was scored."""
        return self.paths.get("scores")

    @property
    def sensitivity(self) -> Path | None:
        """The folder with `sensitivity.json`, if that was asked for."""
        return self.paths.get("sensitivity")

    @cached_property
    def metrics(self) -> dict[str, Any] | None:
        """The object of `scores/metrics.json`."""
        return _object(self.scores, "metrics.json")

    @cached_property
    def sensitivities(self) -> dict[str, Any] | None:
        """The object of `sensitivity/sensitivity.json`."""
        return _object(self.sensitivity, "sensitivity.json")

    @cached_property
    def images(self) -> dict[str, str]:
        """Where the image of every usable frame lies, by frame_id: paths or URLs."""
        root = str(self.facts("ingest").get("photo_root", ""))
        return image_locations(self.frames, root, self.paths.get("images", Path("images")))

    @property
    def is_local(self) -> bool:
        """Whether the run's world is a room or a yard rather than the earth."""
        return bool(self.facts("ingest").get("world", EARTH) == LOCAL_WORLD)

    def facts(self, stage: str) -> Mapping[str, Any]:
        """What a stage recorded; empty if it never ran."""
        facts: Mapping[str, Any] = self.records.get(stage, {}).get("facts", {})
        return facts

    def setting(self, stage: str, key: str) -> Any:
        """The value a stage ran with, None if it never ran or has no such key."""
        return self.records.get(stage, {}).get("config", {}).get(key, {}).get("value")

    def rows(self, stage: str, output: str) -> int:
        """Rows of a table as the manifest counted them."""
        return int(self.records.get(stage, {}).get("outputs", {}).get(output, {}).get("rows", 0))

    def _table(self, name: str) -> pa.Table:
        return read_table(self.paths[name], name)


def _object(folder: Path | None, name: str) -> dict[str, Any] | None:
    if folder is None or not (folder / name).is_file():
        return None
    found: dict[str, Any] = json.loads((folder / name).read_text(encoding="utf-8"))
    return found
