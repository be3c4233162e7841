"""Convert checkpoints of the earlier release 0.1.0 to the form that this release writes."""

from typing import Any

import torch
from torch import Tensor

from refgs.model.learned import DARKEST
from refgs.model.surfels import raw_metallic
from refgs.render.baselines import LinearLight
from refgs.train.material.metals import HELD

RENAMED = {
    "poses": "poses.values",
    "mirrored": "light.weight",
    "motion.total": "densification.total",
    "motion.views": "densification.views",
}


def as_of_today(
    tensors: dict[str, Tensor], facts: dict[str, Any], light: LinearLight
) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Convert the tensors and facts of a checkpoint of release 0.1.0 to the present form. Return those of later releases unchanged.

    0.1.0 had no `held`, `told`, `shown_color` and `roughest`: surfels with a metallic value in HELD did not learn it. All parts (see
    `Part`) shared one table of facts. Linear light was the softplus of raw texels, and is their exponential now. `light` is how the run
    represents light.
    """
    if "residual" in facts:
        return tensors, facts
    tensors = {RENAMED.get(name, name): value for name, value in tensors.items()}
    if not light.display and (raw := tensors.get("environment")) is not None:
        tensors = {name: value for name, value in tensors.items() if not name.startswith("adam.environment.")}
        tensors["environment"] = light.raw(torch.nn.functional.softplus(raw)).clamp_min(DARKEST)
    if (metallic := tensors.get("parameter.metallic")) is not None:
        tensors["parameter.held"] = torch.isin(metallic, torch.tensor([raw_metallic(value) for value in HELD]))
        tensors["parameter.told"] = torch.zeros_like(tensors["parameter.held"])
        tensors["parameter.shown_color"] = torch.zeros(len(metallic), 4)
        tensors["parameter.roughest"] = torch.ones(len(metallic))
    elif "constant.metallic" in tensors:
        tensors["constant.held"] = tensors["constant.told"] = torch.zeros(1, dtype=torch.bool)
        tensors["constant.shown_color"] = torch.zeros(1, 4)
        tensors["constant.roughest"] = torch.ones(1)
    harmonics = tensors.get("parameter.sh_rest")
    known = {"spent": facts.get("seconds", 0.0), "processor_seconds": 0.0, "decided": {}, "needs": {}} | facts
    known |= {"residual": harmonics is not None and bool(harmonics.any()), "clock": facts.get("parts", {})}
    known["parts"] = {
        "metals": {"found": facts.get("metals_set", True)},
        "poses": {"judged": facts.get("poses_judged", True)},
        "coarse": {"factor": facts.get("reduced", 1)},
    }
    return tensors, known
