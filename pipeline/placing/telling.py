"""What ingest found, told: facts for the manifest, warnings, and the line for people."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from pipeline.engine.progress import counted
from pipeline.engine.stage import Context
from pipeline.placing.place import Placed
from pipeline.placing.timeline import Timeline
from pipeline.sources.frames import Ingested


def record_facts(context: Context, found: Ingested, placed: Placed, root: str) -> None:
    """Facts that later stages and the manifest need."""
    origin = found.origin
    context.record("photo_root", root)
    context.record("world", found.world)
    context.record("height_datum", found.heights.stated)
    context.record("height_datum_why", found.heights.why)
    context.record("files", len(placed.records))
    context.record(
        "origin",
        None
        if origin is None
        else {
            "latitude_deg": origin.latitude_deg,
            "longitude_deg": origin.longitude_deg,
            "height_m": origin.height_m,
        },
    )
    zones = Counter(record.time_source for record in placed.records if record.time_source)
    context.record("time_sources", dict(sorted(zones.items())))
    if placed.missing:
        context.record("exposures_without_photo", {name: list(told) for name, told in placed.missing.items()})


def warn_of(
    context: Context, found: Ingested, placed: Placed, lines: Sequence[Timeline], unread: Sequence[str], *, stated: bool
) -> None:
    """Everything a careful user would want to hear before believing the result."""
    usable = found.frames.column("usable").to_pylist()
    context.count_items(len(usable), usable.count(False))
    for text in [*unread, *(f"{name}: {why}" for name, why in sorted(found.exposures.problems.items()))]:
        context.warn(f"exposure marks not used: {text}")
    _warn_of_logs(context, placed, lines)
    lost, spare = placed.missing.get("photos", ()), placed.missing.get("triggers", ())
    if lost:
        context.warn(f"{counted(len(lost), 'photo')} missing on the card: {_some(lost)}")
    if spare:
        context.warn(f"{counted(len(spare), 'exposure')} in the log left no photo: {_some(spare)}")
    _warn_of_unusable(context, found, len(usable))
    zoneless = [record.time_source for record in placed.records].count("exif (zone unknown)")
    if zoneless and not stated and not placed.clocks:
        context.warn(
            f"{zoneless} photos do not say their time zone; their local time is read as UTC (state the difference: "
            "--set ingest.clock_offset_s=-36000 for ten hours east)"
        )
    for camera in found.cameras.to_pylist():
        if camera["source"].startswith("EXIF"):
            told = f"{camera['camera_id']}: focal length from {camera['source']}, distortion not known"
            context.warn(f"{told} (a calibration is better: ingest.camera, --camera FILE)")


def _warn_of_logs(context: Context, placed: Placed, lines: Sequence[Timeline]) -> None:
    """What is wrong with the logs, their clocks and mounts."""
    for line in lines:
        for text in line.log.losses:
            context.warn(f"{line.log.location}: {text}")
    for location in placed.idle:
        holds = next(line for line in lines if line.log.location == location)
        why = "it placed no image" if holds.places else "it holds no positions"
        context.warn(f"{location} is not used: {why}")
    for row in placed.clocks:
        if row["problem"]:
            context.warn(f"{row['clock_id']}: {row['method']}, {row['offset_s']:+.2f} s: {row['problem']}")
    for text in placed.notes:
        context.warn(text)


def summary(found: Ingested) -> str:
    """The line for people."""
    usable = found.frames.column("usable").to_pylist()
    sources = found.frames.column("time_source").to_pylist()
    marked = len(found.exposures.of_photo)
    logged = sum(source.startswith("log ") for source in sources)
    return (
        f"{usable.count(True)} of {len(usable)} photos usable, {counted(found.cameras.num_rows, 'camera')}, heights "
        f"{found.heights.stated}"
        + (f", {marked} with RTK exposure marks" if marked else "")
        + (f", {logged} placed by logs" if logged else "")
    )


def _some(texts: Sequence[str]) -> str:
    return "; ".join(texts[:5]) + (f" and {len(texts) - 5} more" if len(texts) > 5 else "")


def _warn_of_unusable(context: Context, found: Ingested, total: int) -> None:
    table = found.frames.filter(found.frames.column("usable").to_numpy(zero_copy_only=False) == False)  # noqa: E712
    if table.num_rows:
        first = table.slice(0, 1).to_pylist()[0]
        context.warn(f"{table.num_rows} of {total} photos are not usable, first {first['image']}: {first['problem']}")
