"""A 1 GB DataFlash log and a 5 GB MCAP: ingest's speed and memory beside the libraries' own plain iteration.

    python benchmarks/big_ingest.py FOLDER [DATAFLASH_BYTES MCAP_BYTES]

The files are written into FOLDER where they are not there yet. Times of two commands in one run compare; alone they
tell the machine. Memory is the resident size of all processes of a command together, the largest seen.
"""

from __future__ import annotations

import subprocess
import sys
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
from big_logs import write_dataflash, write_mcap
from PIL import Image
from PIL.ExifTags import IFD, Base

from pipeline.clocks.gps import utc_from_gps

SECONDS_OF_PHOTOS = range(100, 160)
# Week, time of week and time since boot of the log's first message, as `big_logs` writes them.
WEEK, FIRST_TOW_S = 2317, 300_000.0
DATAFLASH = """
import sys
from pymavlink import DFReader
log, n = DFReader.DFReader_binary(sys.argv[1]), 0
while log.recv_msg() is not None:
    n += 1
print(n)
"""
MCAP = """
import sys
from mcap.reader import make_reader
with open(sys.argv[1], "rb") as stream:
    print(sum(1 for _ in make_reader(stream).iter_messages()))
"""


def main() -> None:
    """Prints a line per file."""
    folder = Path(sys.argv[1])
    sizes = [int(text) for text in sys.argv[2:4]] or [1_000_000_000, 5_000_000_000]
    folder.mkdir(parents=True, exist_ok=True)
    log, bag = folder / "big.BIN", folder / "big.mcap"
    for path, write, size in ((log, write_dataflash, sizes[0]), (bag, write_mcap, sizes[1])):
        if not path.exists():
            write(path, size)
    photos = folder / "photos"
    write_photos(photos)
    program = [sys.executable, "-c", "from stages.app import main; main()", "run", "--to", "ingest", "--jobs", "1"]
    stated = ["--set", "ingest.clock_offset_s=0", "--set", "ingest.max_failed_share=1"]
    jobs = (
        ("DataFlash", log, ["--photos", str(photos), "--logs", str(log)], DATAFLASH),
        ("MCAP", bag, ["--bags", str(bag), "--set", "ingest.pose_topic=/pose"], MCAP),
    )
    for name, path, sources, library in jobs:
        run = folder / f"run-{name}-{time.time_ns()}"
        ours = measured([*program, "--out", str(run), *sources, *stated])
        theirs = measured([sys.executable, "-c", library, str(path)])
        told = [f"{path.stat().st_size / 1e6 / seconds:7.1f} MB/s {mib:6.0f} MiB" for seconds, mib in (ours, theirs)]
        print(f"{name:<10} ingest {told[0]}   library alone {told[1]}   ratio {theirs[0] / ours[0]:.2f}")


def write_photos(folder: Path) -> None:
    """A minute of small bare photos at the log's triggers."""
    folder.mkdir(exist_ok=True)
    for number, second in enumerate(SECONDS_OF_PHOTOS, 1):
        taken = utc_from_gps(WEEK, FIRST_TOW_S + second) + timedelta(milliseconds=137)
        tags = Image.Exif()
        tags[Base.Make], tags[Base.Model] = "A", "B"
        tags.get_ifd(IFD.Exif).update(
            {
                Base.DateTimeOriginal: taken.strftime("%Y:%m:%d %H:%M:%S"),
                Base.SubsecTimeOriginal: f"{taken.microsecond // 1000:03d}",
                Base.FocalLengthIn35mmFilm: 24,
            }
        )
        picture = np.random.default_rng(number).integers(0, 256, (48, 64, 3), np.uint8)
        Image.fromarray(picture).save(folder / f"DJI_{number:04d}.JPG", "JPEG", exif=tags)


def measured(command: list[str]) -> tuple[float, float]:
    """Seconds, and the largest resident size of a command's processes together, MiB."""
    began = datetime.now(UTC)
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True)
    largest = 0.0
    while process.poll() is None:
        largest = max(largest, resident_mib(process.pid))
        time.sleep(0.05)
    seconds = (datetime.now(UTC) - began).total_seconds()
    if process.returncode:
        output = process.stderr.read() if process.stderr else b""
        raise SystemExit(output.decode())
    return seconds, largest


def resident_mib(session: int) -> float:
    """Resident size of all processes of a session, MiB."""
    total = 0
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                fields = (entry / "stat").read_text().rpartition(")")[2].split()
                total += int(fields[21]) if int(fields[3]) == session else 0
            except (OSError, IndexError):
                continue
    return total * 4096 / 2**20


if __name__ == "__main__":
    main()
