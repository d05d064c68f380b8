"""`python -m diffrigid`: one measured and one synthetic identification, and a report of both."""

import argparse
import sys
import time
from collections.abc import Sequence

from diffrigid.demo import LEAD, disc_section, drop_section, paragraphs
from diffrigid.sysid import command
from diffrigid.tables import lined_up
from diffrigid.view.report import HEADER, write_report


def main(arguments: Sequence[str] | None = None) -> int:
    """Fit both, print one table, and write the report; or, with `fit` first, fit what two files say."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if arguments[:1] == ["fit"]:
        return command.main(arguments[1:])
    options = _options(arguments)
    progress = False if options.quiet else None

    def say(text: str) -> None:
        if not options.quiet:
            print(text, flush=True)

    began = time.time()
    say("1 of 2: eight measured drops of a square, the first impact of each (20 s, mostly compiling)")
    drops = drop_section(progress)
    say("2 of 2: three discs, simulated with 3 mm of noise, from 8 starts (15 s)")
    discs = disc_section(progress)
    path = write_report(options.out, "From measured motion to physical parameters", paragraphs(LEAD)[0], [drops, discs])
    table = "\n".join(lined_up(HEADER, [*drops.table, *discs.table]))
    print(f"\n{table}\n\nreport: {path.resolve()}")
    say(f"{time.time() - began:.0f} s")
    return 0


def _options(arguments: Sequence[str]) -> argparse.Namespace:
    what = "Two identifications, one measured and one synthetic: a table, and a page for the browser."
    more = "To fit data of your own: python -m diffrigid fit scene.toml data.csv (see python -m diffrigid fit --help)."
    parser = argparse.ArgumentParser(prog="python -m diffrigid", description=what, epilog=more)
    parser.add_argument("--out", default="diffrigid_report.html", metavar="FILE", help="default: %(default)s")
    parser.add_argument("--quiet", action="store_true", help="print the table only")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    raise SystemExit(main())
