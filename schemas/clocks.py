"""One row per clock: how a source's time is brought to UTC."""

from schemas._columns import TableSchema, count, number, text

CLOCKS = TableSchema(
    "clocks",
    1,
    "Time bases of the sources and what ties them to UTC.",
    (
        text("clock_id", "Name of the clock: a camera, or a log's file."),
        text("source", "What it times: photos or images (a camera), mrk, or the format of a log."),
        text(
            "method",
            "How it is tied to UTC: the log's own anchors; for a camera intervals of events, places, or who stated it.",
        ),
        number("offset_s", "s", "UTC minus the clock's own time."),
        number("sigma_s", "s", "One sigma of the offset.", nullable=True),
        number("drift_ppm", "1e-6", "Drift of the clock against UTC."),
        number("residual_s", "s", "Root mean square of the anchors about the fit.", nullable=True),
        count("anchors", "Events that tie the clock to UTC."),
        text("problem", "What to distrust; empty when nothing was found."),
    ),
)
