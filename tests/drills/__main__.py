"""See `tests.drills.drills`."""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

from tests.drills import drills

NAMES = ("kills", "full_disks", "worker_faults", "damages")


def main() -> None:
    parser = argparse.ArgumentParser(description=drills.__doc__)
    parser.add_argument("--seed", type=int, default=int(time.time()))
    for name in NAMES:
        parser.add_argument(f"--{name}", type=int, default=0)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        drill = drills.Drills(Path(folder), asked.seed)
        try:
            for name in NAMES:
                getattr(drill, name)(getattr(asked, name))
        finally:
            print("\n| drill | end | times |\n|---|---|---|")
            for name, seen in drill.totals.items():
                for end, count in sorted(seen.items()):
                    print(f"| {name} | {end} | {count} |")


if __name__ == "__main__":
    main()
