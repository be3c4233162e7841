"""Write docs/timeline.md, when each thing is done in a training, from backend/refgs/train/timeline.py."""

from pathlib import Path

from refgs.train import timeline
from refgs.train.plan import PART, SHAPES
from refgs.train.timeline import Row

PAGE = Path(__file__).resolve().parents[1] / "docs" / "timeline.md"
HEAD = f"""# When what is done in a training

<!-- Written by `python -m scripts.timeline_page` from backend/refgs/train/timeline.py. -->

An iteration renders one photo and learns from it. Before and after that, the rows below are done, in this order, when they are due. Parts
of the training (20%) are parts of its iterations. A word such as `densify.every` is a [setting](settings.md).

If a time is given (`--minutes`), a row with a cost is left out where it would take more than {PART:.0%} of the iterations, metals' rows
where they would take more than {SHAPES:.0%}. The cost is that of each time if the row has a period, else that of all times together.
"""
TABLES = {
    "Before the photo is rendered": timeline.BEFORE,
    "While it learns from the photo": (timeline.WHOLE, *(row for _, row in timeline.FROZEN)),
    "After that": (*timeline.AFTER, timeline.DIVIDE),
    "Between iterations": (timeline.PLAN, timeline.REPORT, timeline.RECORD, timeline.CHECKPOINT),
}


def page() -> str:
    """Return the text of docs/timeline.md."""
    parts = [HEAD]
    for title, rows in TABLES.items():
        head = ["what", "from", "until", "every", "only if", "cost in iterations"]
        table = [head, ["---"] * len(head), *(_cells(row) for row in rows)]
        parts.append(f"\n## {title}\n\n" + "".join(f"| {' | '.join(cells)} |\n" for cells in table))
    return "".join(parts)


def _cells(row: Row) -> list[str]:
    times = [when.words if when else "" for when in (row.start, row.until)]
    every = row.every.words if row.every else "1"
    return [row.what, *times, every, row.only_if.words if row.only_if else "", str(row.cost or "")]


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
