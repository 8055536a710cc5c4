"""Reports with rows for pairs of shapes: command line, and files in which other pairs keep what earlier runs found."""

from __future__ import annotations

import argparse
import json
import pathlib
from collections.abc import Callable, Sequence

RESULTS = pathlib.Path(__file__).parent / "results"


def run(
    name: str,
    description: str | None,
    counted: tuple[int, str],
    pairs: Sequence[tuple[str, str]],
    measure: Callable[[tuple[str, str], int], list[dict]],
    table: Callable[[list[dict]], str],
    arguments: list[str] | None,
) -> None:
    """Measures the pairs that the command line names, and writes ``results/NAME.json`` and ``.md`` after each.

    Args:
        name: of the module and of both files.
        description: of the program.
        counted: default and meaning of the number on the command line.
        pairs: all of them, in the order of the rows.
        measure: rows of a pair, with its name under "pair", from the pair and the number.
        table: Markdown from all rows.
        arguments: of the command line; None for those of the process.
    """
    parser = argparse.ArgumentParser(prog=f"python -m tests.benchmarks.{name}", description=description)
    parser.add_argument("count", nargs="?", type=int, default=counted[0], help=counted[1])
    parser.add_argument("--pairs", help="names such as box_cone, separated by commas; default all")
    options = parser.parse_args(arguments)
    chosen = None if options.pairs is None else options.pairs.split(",")
    RESULTS.mkdir(exist_ok=True)
    stored = RESULTS / f"{name}.json"
    rows = json.loads(stored.read_text())["rows"] if stored.exists() else []
    order = {"_".join(pair): place for place, pair in enumerate(pairs)}
    for pair in pairs:
        label = "_".join(pair)
        if chosen is not None and label not in chosen:
            continue
        rows = [known for known in rows if known["pair"] != label] + measure(pair, options.count)
        rows.sort(key=lambda row: order[row["pair"]])
        stored.write_text(json.dumps({"rows": rows}, indent=0) + "\n")
        (RESULTS / f"{name}.md").write_text(table(rows))
