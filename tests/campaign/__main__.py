"""Attacks on the suite, each case from a seed: `scripts/campaign --help`.

An area is a module with `attack(seed, directory)`: it makes one hostile case inside the directory, runs it, and
raises what must not happen (an exception of another kind than the suite's own, a wrong exit status). A worker
process takes the seeds of an area one after the other under a limit on time and memory; what kills it counts too.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from driver import campaign

AREAS = ("bags", "packs", "messages", "parameters", "scenarios", "environments", "kills", "nodes", "starts", "clocks")
AREAS += ("doors", "links", "services", "floods", "ends")


def main() -> int:
    """Run the requested attacks and print one table."""
    parser = argparse.ArgumentParser(prog="scripts/campaign", description=__doc__.splitlines()[0])
    parser.add_argument("areas", nargs="*", metavar="AREA", help=f"{', '.join(AREAS)} (default all)")
    parser.add_argument("--count", type=int, default=200, help="cases an area")
    parser.add_argument("--seed", type=int, default=0, help="first seed")
    parser.add_argument(
        "--limit", type=float, default=3600.0, metavar="S", help="end after; cases that run then are not counted"
    )
    parser.add_argument("--keep", type=Path, metavar="DIR", help="files of the cases that were lost go here")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    options = parser.parse_args()
    counts = dict.fromkeys(options.areas or AREAS, options.count)
    unknown = set(counts) - set(AREAS)
    if unknown:
        parser.error(f"no area {', '.join(sorted(unknown))}; there are {', '.join(AREAS)}")
    table = campaign(counts, options.seed, options.limit, options.keep, options.jobs)
    print(f"\n{'area':14}{'tried':>8}{'survived':>10}{'lost':>6}{'CPU s':>8}")
    for area, (tried, survived, findings, seconds) in table.items():
        print(f"{area:14}{tried:8}{survived:10}{len(findings):6}{seconds:8.0f}")
        kinds: dict[str, list[int]] = {}
        for seed, finding in findings:
            kinds.setdefault(finding.strip().splitlines()[-1][:160], []).append(seed)
        for kind, seeds in kinds.items():
            print(f"    {len(seeds)} x {kind} (seed {', '.join(map(str, seeds[:5]))})")
    return int(any(row[2] for row in table.values()))


if __name__ == "__main__":
    raise SystemExit(main())
