"""Test splats in USD: OpenUSD's own schemas read them, and its validators find nothing."""

import numpy as np
import pytest
from pxr import Sdf, Usd, UsdGeom, UsdValidation, UsdVol
from scipy.spatial.transform import Rotation

from refgs.formats.splats import THIN
from refgs.formats.splats_usd import write_splats_usd
from tests.makers.splats import make


def opened(file, kernel=None):
    """Open a USD file. Returns its stage and its prim of splats, with the variant `kernel` selected."""
    stage = Usd.Stage.Open(str(file))
    root = stage.GetDefaultPrim()
    if kernel:
        assert root.GetVariantSet("kernel").GetVariantSelection() == "ellipsoid"
        assert root.GetVariantSet("kernel").SetVariantSelection(kernel)
    (prim,) = root.GetChildren()
    assert [*stage.TraverseAll()] == [root, prim]
    return stage, prim


def complaints(stage):
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) > 20
    return [(e.GetName(), e.GetMessage()) for e in UsdValidation.ValidationContext(validators).Validate(stage)]


@pytest.mark.parametrize("kernel", ["ellipsoid", "surflet"])
@pytest.mark.parametrize("coefficients", [1, 16])
def test_surfels(tmp_path, coefficients, kernel):
    splats = make(50, coefficients)
    write_splats_usd(tmp_path / "des éclats.usdc", splats)
    assert (tmp_path / "des éclats.usdc").read_bytes()[:8] == b"PXR-USDC"
    # The text format cannot say all that the binary one can.
    layer = Sdf.Layer.FindOrOpen(str(tmp_path / "des éclats.usdc"))
    layer.Export(str(tmp_path / "as text.usda"))
    stage, prim = opened(tmp_path / "as text.usda", kernel)
    assert not complaints(stage) and UsdGeom.GetStageUpAxis(stage) == "Z"
    assert prim.GetTypeName() == ("ParticleField" if kernel == "surflet" else "ParticleField3DGaussianSplat")
    assert prim.HasAPI(UsdVol.ParticleFieldKernelGaussianSurfletAPI) == (kernel == "surflet")
    assert prim.HasAPI(UsdVol.ParticleFieldKernelGaussianEllipsoidAPI) == (kernel == "ellipsoid")
    places = np.array(UsdVol.ParticleFieldPositionAttributeAPI(prim).GetPositionsAttr().Get())
    np.testing.assert_array_equal(places, splats.positions)
    scales = np.array(UsdVol.ParticleFieldScaleAttributeAPI(prim).GetScalesAttr().Get())
    np.testing.assert_array_equal(scales[:, :2], splats.scales)
    np.testing.assert_allclose(scales[:, 2], THIN * splats.scales.min(axis=1), rtol=1e-6)
    turns = UsdVol.ParticleFieldOrientationAttributeAPI(prim).GetOrientationsAttr().Get()
    wxyz = np.array([[q.real, *q.imaginary] for q in turns])
    np.testing.assert_array_equal(wxyz, splats.rotations)
    opacities = UsdVol.ParticleFieldOpacityAttributeAPI(prim).GetOpacitiesAttr().Get()
    np.testing.assert_array_equal(opacities, splats.opacities)
    colours = UsdVol.ParticleFieldSphericalHarmonicsAttributeAPI(prim)
    assert (colours.GetRadianceSphericalHarmonicsDegreeAttr().Get() + 1) ** 2 == coefficients
    harmonics = np.array(colours.GetRadianceSphericalHarmonicsCoefficientsAttr().Get())
    np.testing.assert_array_equal(harmonics.reshape(50, coefficients, 3), splats.sh)
    low, high = UsdGeom.Boundable(prim).GetExtentAttr().Get()
    ends = Rotation.from_quat(wxyz[:, [1, 2, 3, 0]]).as_matrix() * 3 * scales[:, None]
    assert (places - np.abs(ends).max(axis=2) > low).all() and (places + np.abs(ends).max(axis=2) < high).all()


def test_gaussians_have_no_other_kernel(tmp_path):
    splats = make(3, 1)
    splats.scales = np.repeat(splats.scales[:, :1], 3, axis=1)
    write_splats_usd(tmp_path / "a.usdc", splats)
    stage, prim = opened(tmp_path / "a.usdc")
    assert not complaints(stage) and not prim.GetParent().HasVariantSets()
    assert prim.IsA(UsdVol.ParticleField3DGaussianSplat)
