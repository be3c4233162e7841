"""Describe the TOML file of a checkpoint. It holds everything that the next iteration depends on, except the tensors."""

from typing import Annotated

from pydantic import Field

from refgs.formats.needs import Found
from refgs.formats.validate import Finite, Model

Count = Annotated[int, Field(ge=0, le=10**9, strict=True)]
Seconds = Annotated[Finite, Field(ge=0)]


class Facts(Model):
    """Hold everything in a checkpoint except its tensors. Times are in seconds.

    - `iteration`, `total`: the number of iterations done, and the number of iterations in the whole training
    - `seconds`, `processor_seconds`: the wall time and the CPU time of the iterations
    - `spent`: the wall time of the whole training from the start of its command, without pauses
    - `initial`: true while the initial stage lasts, in which each surfel is shaded before blending
    - `residual`: true once the surfels learn a residual, a colour that material and light do not explain
    - `decided`: the last line that told the user about a decision, by the decision's topic
    - `details`: the topics in `decided` whose line is a detail, which only log.txt has
    - `clock`: the time spent on each kind of work, such as shading, by its name
    - `needs`: the decisions about optional parts of the training, such as inter-reflection, by the part's name
    - `parts`: the numbers and flags that each `refgs.train.part.Part` remembers, by its name. A `Part` is the memory of one task of the
      training, such as aligning poses.
    """

    iteration: Count
    total: Count
    seconds: Seconds
    initial: bool | None = None  # 0.1.0 had no such stage
    residual: bool
    spent: Seconds
    processor_seconds: Seconds
    decided: dict[str, str]
    details: tuple[str, ...] = ()  # earlier releases told none from the others
    clock: dict[str, Finite]
    needs: dict[str, Found]
    parts: dict[str, dict[str, bool | Count]]
