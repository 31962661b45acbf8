"""Every matcher on the example's two flights and on real sets: what it finds, how right it is, what it costs.

usage: python benchmarks/matchers.py EXAMPLE

Each matcher runs on each set in a process of its own (matcher_side.py), on the same few pairs, with its own settings.
Weights are looked for as everywhere ($EPITRANSFER_WEIGHTS, the cache); without them a matcher's row says so. Real sets
are looked for in $EPITRANSFER_SHARED or ../shared.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path

from match_sets import EXACT, EXAMPLE, LOGGED, Flight, PhotoSet, example_sets, real_sets, shared_folder
from matcher_side import LAWN, NEAR_SHARE, REST, RIGHT_PX, ROOF, Outcome, Task, Worth

MATCHERS = ("sift", "xfeat", "xfeat-star", "xfeat-lighterglue", "raft", "dis")
FIRST = MATCHERS[0]
MOST_PAIRS, PROCESSES = 4, 2
# At full size RAFT takes a minute a pair on one core.
MATCHED_PX, RAFT_PX = 1600, 800
LOW_TEXTURE = ("example lawn", "brighton_beach")
MARKS = {EXAMPLE: "true pose", EXACT: "the set's own poses", LOGGED: "* pair's own geometry"}

Outcomes = dict[str, Outcome]


def outcome_of(photos: PhotoSet, matcher: str) -> Outcome:
    """What a process of its own finds.

    Raises:
        RuntimeError: It failed; its last words are in the message.
    """
    task = Task.of(photos, matcher, RAFT_PX if matcher == "raft" else MATCHED_PX, MOST_PAIRS)
    command = [sys.executable, str(Path(__file__).with_name("matcher_side.py")), json.dumps(asdict(task))]
    done = subprocess.run(command, text=True, capture_output=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{matcher} on {photos.name} ended with {done.returncode}:\n{done.stderr[-2000:]}")
    return Outcome.of(json.loads(done.stdout))


def share(part: int, whole: int) -> str:
    """A share in percent, 6 wide; "-" of nothing."""
    return f"{part / whole:6.1%}" if whole else f"{'-':>6}"


def times(value: float, reference: float) -> str:
    """How many times a reference, 6 wide."""
    if not (value and reference):
        return f"{'-':>6}"
    ratio = value / reference
    return f"{ratio:6.2f}" if ratio < 100.0 else f"{ratio:6.0f}"


def block(photos: PhotoSet, found: Outcomes) -> Iterator[str]:
    """The rows of one set in the first table."""
    flight = Flight.of(photos.run)
    camera = next(iter(flight.cameras.values()))
    pairs = flight.some_pairs(MOST_PAIRS)
    yield (
        f"{photos.name}: {len(pairs)} of {len(flight.pairs)} pairs, photos of {camera.width} x {camera.height}; "
        f"right by {MARKS[photos.poses]}"
    )
    mark = "*" if photos.poses == LOGGED else " "
    for name, out in found.items():
        if out.missing:
            yield f"  {name:18}{out.missing}"
            continue
        image = f"{out.image_s:9.2f}{times(out.image_s, found[FIRST].image_s)}" if out.images else f"{'-':>9}{'-':>6}"
        yield (
            f"  {name:18}{out.made / out.pairs:7,.0f} {share(out.fitted, out.made)}{worth(out.kept, out.pairs, mark)}"
            f"{image}{out.pair_s:9.2f}{times(out.pair_s, found[FIRST].pair_s)}{out.memory_mib:7.0f}"
        )


def worth(kept: Worth, pairs: int, mark: str) -> str:
    """How many matches are kept per pair, and how right they are."""
    error = f"{kept.error_px[0]:8.2f}{kept.error_px[1]:7.2f}" if kept.error_px else f"{'-':>8}{'-':>7}"
    return f"{kept.matches / pairs:7,.0f}  {share(kept.right, kept.judged)}{mark}{error}"


def first_table(done: list[tuple[PhotoSet, dict[str, Future[Outcome]]]]) -> dict[str, Outcomes]:
    """Prints the first table, set by set as they are done; returns the outcomes by set and matcher."""
    print("Matches of the same pairs under the logged poses, per pair")
    print("  made   matches, duplicates left out")
    print("  fit    of those made, whose patches fit: only these are kept")
    print("  kept   also agree with the pose within its error, and with one another")
    print(f"  right  of these, within {RIGHT_PX:g} px (at the size matched at) of the epipolar line by the pose named")
    print("  px     distance of those kept from the true place, px of the photo as given: median and 90 %")
    print("  s      CPU seconds on one thread: a photo's features; a pair's matches, fit and checks; x: times SIFT's")
    print(f"  MiB    most memory of the process. Matched at {MATCHED_PX} px at most, raft at {RAFT_PX}.")
    print(f"One run of each, {PROCESSES} beside one another: the times compare within this table alone.\n")
    print(
        f"  {'':18}{'made':>7} {'fit':>6}{'kept':>7}  {'right':>6} {'px':>8}{'90 %':>7}{'s/photo':>9}{'x':>6}"
        f"{'s/pair':>9}{'x':>6}{'MiB':>7}"
    )
    found: dict[str, Outcomes] = {}
    for photos, futures in done:
        found[photos.name] = {name: future.result() for name, future in futures.items()}
        for line in block(photos, found[photos.name]):
            print(line, flush=True)
    if any(photos.poses == LOGGED for photos, _ in done):
        print("* Nothing else is known of these: that matches agree says little of the poses, and nothing of ranges.")
    if any(photos.poses == EXACT for photos, _ in done):
        print("The sets' own poses: hololens's, by the headset's tracking, are good to 1 px; fountain_p11's to 0.3 px.")
    return found


def second_table(found: dict[str, Outcomes]) -> None:
    """Prints what is left where there is little texture."""
    print("\nLow texture: depths kept per pair, under the logged poses and the default limits; x: times SIFT's")
    print(f"  near   of those with a truth, within {NEAR_SHARE:.0%} of it")
    if real := LOW_TEXTURE[1] in found:
        print(f"  {LOW_TEXTURE[1]} is the real set with the fewest SIFT matches for its pixels: sand, grass and water")
    print(f"\n  {'':18}{LOW_TEXTURE[0]:>14}" + (f"{'':48}{LOW_TEXTURE[1]:>16}" if real else ""))
    print(
        f"  {'':18}{'all':>7}{'x':>7}{'near':>8}{LAWN:>8}{'x':>7}{ROOF:>8}{'x':>7}{REST:>8}{'x':>7}"
        + (f"{'all':>9}{'x':>7}" if real else "")
    )
    lawn, other = found[LOW_TEXTURE[0]], found.get(LOW_TEXTURE[1])
    for name, out in lawn.items():
        if out.missing:
            print(f"  {name:18}{out.missing}")
            continue
        print(f"  {name:18}" + low_cells(out.kept, out, lawn[FIRST]) + (real_cells(name, other) if other else ""))


def low_cells(kept: Worth, out: Outcome, base: Outcome) -> str:
    """One matcher on the lawn."""
    cells = f"{kept.depths / out.pairs:7,.0f}{times(kept.depths, base.kept.depths):>7}"
    cells += f"{share(kept.depths_near, kept.depths_true):>8}"
    for name in (LAWN, ROOF, REST):
        count = kept.by_surface[name]
        cells += f"{count / out.pairs:8,.0f}{times(count, base.kept.by_surface[name]):>7}"
    return cells


def real_cells(name: str, found: Outcomes) -> str:
    """One matcher on the real set."""
    out = found[name]
    return f"{out.kept.depths / out.pairs:9,.0f}{times(out.kept.depths, found[FIRST].kept.depths):>7}"


def main(example: Path) -> None:
    """Runs every matcher on every set and prints the tables."""
    shared = shared_folder()
    with tempfile.TemporaryDirectory(prefix="matchers.") as folder, ThreadPoolExecutor(PROCESSES) as pool:
        work = Path(folder)
        sets = [
            *example_sets(example, work),
            *(real_sets(shared, work) if shared else ["no real sets in $EPITRANSFER_SHARED or ../shared"]),
        ]
        done = [
            (photos, {name: pool.submit(outcome_of, photos, name) for name in MATCHERS})
            for photos in sets
            if isinstance(photos, PhotoSet)
        ]
        for line in sets:
            if isinstance(line, str):
                print(line)
        second_table(first_table(done))


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python benchmarks/matchers.py EXAMPLE")
    main(Path(sys.argv[1]))
