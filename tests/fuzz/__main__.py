"""Damage files for a while and print what came of it: `python -m tests.fuzz --seconds 600`."""

import argparse
import json
import sys
from collections import Counter
from pathlib import Path

from tests.fuzz.engine import KINDS, fuzz


def main() -> int:
    """Print the table; 1 if a case came out as none must."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--seconds", type=float, default=60, help="of processor time (default 60)")
    parser.add_argument("--seed", type=int, default=0, help="of all cases (default 0)")
    parser.add_argument("--start", type=int, default=0, help="index of the first case (default 0)")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS, help="only these")
    parser.add_argument(
        "--bad", type=Path, help="file for the cases that must not be, as JSON lines"
    )
    args = parser.parse_args()
    result = fuzz(args.seconds, args.seed, args.kinds, args.start)
    print(result.table())
    if args.bad:
        args.bad.write_text(
            "".join(json.dumps(case) + "\n" for case in result.bad), encoding="utf-8"
        )
    seen = Counter((case["kind"], case["outcome"], case["detail"]) for case in result.bad)
    for (kind, outcome, detail), count in seen.most_common(40):
        print(f"{count} x {kind}: {outcome}: {detail!r}", file=sys.stderr)
    return 1 if result.bad else 0


if __name__ == "__main__":
    sys.exit(main())
