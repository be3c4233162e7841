"""Learn the relief of coloured metal as normals, not as differences of base colour and roughness.

Base colour and roughness that differ from surfel to surfel explain the shading of an embossed metal as well as normals do, and they learn
faster. So until late in the training, both are averaged over neighbouring surfels of coloured metal. Normals must then explain finer
detail. Later, the photos add what normals do not explain, such as dirt in the hollows. Grey metals are left alone, because they may have
real patterns, coloured or grey: print, brushing and tarnish.
"""

import torch
from torch import Tensor

from refgs.model.surfels import Surfels
from refgs.train.material.metals import Metals
from refgs.train.material.observe import COLOURED, from_grey, mean_over, neighbours
from refgs.train.state import State
from refgs.train.timeline import Step

AVERAGED = 16  # neighbours
METALLIC = 0.8


def coloured_metal(surfels: Surfels) -> Tensor:
    """Tell which surfels (N,) are coloured metal, by the materials learned so far."""
    return (surfels.metallic > METALLIC) & (from_grey(surfels.albedo).norm(dim=1) > COLOURED)


@torch.no_grad()
def even_out(state: State, step: Step) -> None:
    """Average base colour and roughness of coloured metal over neighbouring surfels of coloured metal."""
    if not state.part(Metals).found:
        return
    surfels = state.surfels()
    if not (metal := coloured_metal(surfels)).any():
        return
    near = neighbours(surfels.positions, AVERAGED, metal)
    weight = (surfels.opacities * metal).view(-1, 1)
    for name in {"albedo", "roughness"} & state.learned.keys():
        values = state.learned[name]
        mean = mean_over(near, values.view(len(weight), -1), weight)
        values[metal] = mean.view_as(values[metal])
