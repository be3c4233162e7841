"""Write docs/measurements.md from docs/measurements.csv: `refgs bench page`."""

import argparse
from collections.abc import Sequence

from benchmarks import gpu, kernels, minutes, needs, truth
from benchmarks.harness import KEPT, Row, markdown_table, read
from refgs.paths import whole

PAGE = KEPT.with_suffix(".md")
HEAD = """# Measurements

Machine: {machine}. Date: {date}.

`refgs bench page` writes this page from [measurements.csv](measurements.csv), which has the date and commit of each
figure. [The notebook](notebook/README.md) tells how they came about; [run-folder.md](run-folder.md#what-the-figures-mean) says
what they mean.
"""
SECTIONS = (
    (
        "Where the truth is known",
        """`refgs bench truth --scenes DIR --preset quick --variants deferred`: 100 photos of 256×256 and 8 held-out views, rendered by
Cycles; 3,000 iterations, one scene on each of two cores. Relit and light are compared with Cycles and the true panorama. Base colour and
"aligned" are after one scale a channel. The mean is of the reflective scenes. [The notebook](notebook/scenes.md) has the preset
`standard`, and colour by direction.""",
        truth.TABLES,
    ),
    (
        "What scenes do without",
        """`refgs bench needs --scenes DIR`: preset `quick`, 3,000 iterations. "All on" leaves nothing out; "as decided" leaves out what the
photos say the scene does not need ([how that is decided](run-folder.md#what-a-scene-does-without)). Seconds are the processor's.""",
        needs.TABLES[:1],
    ),
    (
        "What a given time brings",
        """`refgs bench minutes --scenes DIR`: one core a training; seconds count from the command to the written asset. Beside the held-out
PSNR stands the best that a preset had reached by then. The same training again differs by up to 0.1 dB.""",
        minutes.TABLES,
    ),
    (
        "Kernels",
        """`refgs bench kernels`: least milliseconds; the floor is what the operations and bytes of a part take at least on this machine.
An iteration is of the deferred stage.""",
        kernels.TABLES,
    ),
    (
        "On a CUDA card",
        """`refgs bench gpu`; the floors are what the bytes and the operations take at least on this card. [The notebook](notebook/speed.md)
has the kernels of an iteration, and trainings.""",
        gpu.TABLES[:2],
    ),
)


def markdown(rows: Sequence[Row]) -> str:
    """Make the text of docs/measurements.md from rows of docs/measurements.csv."""
    machines, dates = "; ".join(sorted({row.machine for row in rows})), sorted({row.date for row in rows})
    parts = [HEAD.format(machine=machines, date=" to ".join(dict.fromkeys((dates[0], dates[-1]))))]
    for title, text, tables in SECTIONS:
        found = [lines for table in tables if len(lines := table.lines(rows)) > 1]
        parts += [f"## {title}\n\n{text}\n"] if found else []
        parts += [markdown_table(lines) + "\n" for lines in found]
    return "\n".join(parts)


def main(arguments: Sequence[str] | None = None) -> None:
    """Write docs/measurements.md."""
    argparse.ArgumentParser(prog="refgs bench page", description=__doc__.splitlines()[0]).parse_args(arguments)
    with whole(PAGE) as temporary:
        temporary.write_text(markdown(read(KEPT)), encoding="utf-8")
    print(PAGE)
