"""Write a preview of a training while it runs."""

import numpy as np
import torch

from refgs.compare.pictures import color_picture, write_png
from refgs.formats.splats import write_splats
from refgs.model.surfels import to_splats
from refgs.render.volume import with_normals_last
from refgs.train.state import State

PREVIEW = "preview"  # in the run folder


def write_preview(state: State) -> dict[str, str | int]:
    """Write the present surfels to RUN/preview/splats.ply, and a picture of them to RUN/preview/view.png.

    The picture is of the first held-out view, or of the first training view if there is none. Surfels outside the region to train are left
    out. Each file is written whole or not at all. Returns a dict of the paths `splats` and `view`, and of the `iteration`.
    """
    folder = state.folder / PREVIEW
    view = (state.test or state.views)[0]
    with torch.no_grad():
        wanted = state.wanted()
        # All, if no surfel is left in the region.
        surfels = state.surfels().chosen(wanted if wanted.any() else ~wanted)
        rendering = state.render(view.camera, surfels)
        write_png(folder / "view.png", color_picture(rendering, np.array(state.settings.image.background)))
        write_splats(folder / "splats.ply", to_splats(with_normals_last(surfels)))
    files = {name: str((folder / file).resolve()) for name, file in (("view", "view.png"), ("splats", "splats.ply"))}
    return {"iteration": state.iteration, **files}
