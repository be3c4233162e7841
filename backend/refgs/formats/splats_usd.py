"""Write splats as USD, in the schemas of particle fields that OpenUSD's module UsdVol defines."""
# pyright: reportAttributeAccessIssue=false
# OpenUSD's modules fill themselves when they are loaded.

import os
import shutil
import tempfile
from pathlib import Path

import numpy as np

from refgs.formats.splats import Splats, three_scales
from refgs.paths import whole

REACH = 3.0  # standard deviations that the extent holds: the kernels' support
PLACE = "/RefGS/splats"
ELLIPSOIDS, FIELD = "ParticleField3DGaussianSplat", "ParticleField"  # types of prims
SURFLETS = (  # what makes a field one of surfels
    *(
        f"ParticleField{part}AttributeAPI"
        for part in ("Position", "Orientation", "Scale", "Opacity", "SphericalHarmonics")
    ),
    "ParticleFieldKernelGaussianSurfletAPI",
)


def write_splats_usd(path: str | os.PathLike, splats: Splats) -> None:
    """Write splats as a binary USD file (.usdc), as the prim PLACE of type ParticleField3DGaussianSplat, without materials.

    Z is up, and a unit is a metre. Scales and opacities are linear; colours by direction are sRGB-encoded, with the primaries of Rec.709.

    Surfels have a variant set `kernel`. Its variant `ellipsoid` is that prim. Its variant `surflet` is a ParticleField of flat discs, for
    programs that know ParticleFieldKernelGaussianSurfletAPI. The splats are stored once.
    """
    from pxr import Gf, Sdf, Usd, UsdGeom, UsdVol, Vt

    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1)
    root = stage.DefinePrim(Sdf.Path(PLACE).GetParentPath(), "Xform")
    stage.SetDefaultPrim(root)
    if splats.scales.shape[1] == 3:
        stage.DefinePrim(PLACE, ELLIPSOIDS)
    else:
        kernels = root.GetVariantSets().AddVariantSet("kernel")
        for name, kind, parts in (("surflet", FIELD, SURFLETS), ("ellipsoid", ELLIPSOIDS, ())):
            kernels.AddVariant(name)
            kernels.SetVariantSelection(name)  # the last one stays
            with kernels.GetVariantEditContext():
                prim = stage.DefinePrim(PLACE, kind)
                for part in parts:
                    prim.AddAppliedSchema(part)
    prim = stage.OverridePrim(PLACE)  # outside of the variants, for both
    Usd.ColorSpaceAPI.Apply(prim).CreateColorSpaceNameAttr(Gf.ColorSpaceNames.SRGBRec709)
    field, scales = UsdVol.ParticleField3DGaussianSplat(prim), three_scales(splats)
    field.CreatePositionsAttr(Vt.Vec3fArray.FromNumpy(splats.positions))
    field.CreateOrientationsAttr(Vt.QuatfArray.FromNumpy(splats.rotations[:, [1, 2, 3, 0]]))  # the real part is last
    field.CreateScalesAttr(Vt.Vec3fArray.FromNumpy(scales))
    field.CreateOpacitiesAttr(Vt.FloatArray.FromNumpy(splats.opacities))
    field.CreateRadianceSphericalHarmonicsDegreeAttr(int(splats.sh.shape[1] ** 0.5) - 1)
    field.CreateRadianceSphericalHarmonicsCoefficientsAttr(Vt.Vec3fArray.FromNumpy(splats.sh.reshape(-1, 3)))
    if len(splats):
        reach = REACH * scales.max(axis=1, keepdims=True)
        corners = np.stack([(splats.positions - reach).min(axis=0), (splats.positions + reach).max(axis=0)])
        field.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(corners))
    with tempfile.TemporaryDirectory() as work, whole(Path(path)) as temporary:
        named = Path(work) / "splats.usdc"  # USD takes the format from the name
        stage.GetRootLayer().Export(str(named))
        shutil.copyfile(named, temporary)
