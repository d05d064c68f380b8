"""`python -m diffrigid fit scene.toml data.csv [more.csv ...]`: a fit from files."""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from diffrigid import scene_file
from diffrigid.sysid.csv_file import read_csv
from diffrigid.sysid.fit import fit
from diffrigid.sysid.result import Fit
from diffrigid.sysid.summary import load_fit
from diffrigid.sysid.table import FAILED


def main(arguments: Sequence[str]) -> int:
    """Fit a scene to data, and print the table. Several files of data are records of one scene, fitted together.

    The status is 0, 1 after a fit that failed, and 2 where something is wrong with the files.
    """
    parser = argparse.ArgumentParser(
        prog="python -m diffrigid fit", description=main.__doc__, epilog=scene_file.__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("scene", help="TOML file, as below")
    parser.add_argument("data", nargs="+", help="CSV files: columns t, ball.x[0], ball.x[1], ball.angle, ...")
    parser.add_argument("--held-out", metavar="FILE", nargs="+", help="score the fit on records that it did not see")
    parser.add_argument("--out", metavar="FILE", help="write the result as JSON")
    parser.add_argument("--report", metavar="FILE", help="write a page for the browser")
    parser.add_argument("--resume", metavar="FILE", help="start from a result")
    options = parser.parse_args(arguments)
    try:
        read = scene_file.read_scene(options.scene)
        records, held_out = (
            [_record(path, read.columns) for path in paths or ()] for paths in (options.data, options.held_out)
        )
        observations = records if len(records) > 1 else records[0]
        resume = None if options.resume is None else load_fit(options.resume)
        found = fit(
            read.world, read.state, observations, free=read.free, observe=read.observe, resume=resume, **read.options
        )  # fmt: skip
        print(found)
        if options.out:
            print(f"written to {found.save(options.out)}")
        if options.report:
            title = f"{Path(options.scene).stem}: {', '.join(Path(name).name for name in options.data)}"
            print(f"report: {found.report(options.report, title)}")
        if held_out:
            print(_scored(found, held_out))
    except (ValueError, OSError) as error:
        parser.exit(2, f"{parser.prog}: {error}\n")
    return int(FAILED in found.doubts)


def _scored(found: Fit, records: Sequence[Any]) -> str:
    """Root mean square of the residuals of records that were held out, beside the noise of the fit."""
    sizes = [
        f"{name} {size:.3g} ({size / found.noise[name]:.2g} times the noise)" if name in found.noise else
        f"{name} {size:.3g}"
        for name, size in found.score(records).items()
    ]  # fmt: skip
    return f"held out: root mean square of {', '.join(sizes)}"


def _record(path: str, columns: Mapping[str, tuple[str, float]]) -> Any:
    """A file, or those of its columns that are named, by their names here."""
    if not columns:
        return path
    table = read_csv(path, only={theirs: ours for ours, (theirs, _) in columns.items()})
    return {ours: factor * table[theirs] for ours, (theirs, factor) in columns.items()}
